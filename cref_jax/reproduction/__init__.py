"""A plan of trainings: variants and seeds, one after the other, and the tables of their results."""
