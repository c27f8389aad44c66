"""Figures of studies and of single solves; every function returns a matplotlib Figure and shows nothing."""
