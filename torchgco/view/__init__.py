"""A page that shows trajectories among obstacles in three dimensions: one HTML file, which needs no network.

`torchgco.view.notebook.show` makes it of a problem and its solution, the command `torchgco-view` of a study. The page
draws with three.js, which lies in `vendor/three` as its authors built it, with its licence. `document` gathers what it
shows, `shapes` the obstacles, `packing` writes arrays. It imports `plotting`. Begin with `document.py`.
"""
