"""Counts, intervals and pairs, and the tables that show them."""
