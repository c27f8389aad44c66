"""Figures of studies and of single solves; every function returns a matplotlib Figure and shows nothing.

`problems.plot` draws a solve, `study_figure` and `layouts` studies, `world` and `scene` what is in a picture, `style`
how. It imports `judging` and `scenarios`. Begin with `problems.py`.
"""
