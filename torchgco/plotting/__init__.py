"""Figures of studies and of single solves; every function returns a matplotlib Figure and shows nothing.

`problems.solution_figure` draws a solve, `study_figure` and `layouts` studies, `scene` is what is in a picture,
`style` how it looks. Obstacles are `bodies`, which `layouts.draw_obstacles` draws. It imports `judging` and
`scenarios`. Begin with `problems.py`.
"""
