"""Success rates, tables and suites of a trained policy."""
