"""Counts, intervals, pairs and sample sizes, and the tables that show them."""
