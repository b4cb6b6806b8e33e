"""The physics step, with one engine per backend."""
