"""What a trajectory is worth, by code that no solver shares: judge, certificate, contact.

`judge.judge` simulates controls again and says whether they are feasible and reach the goal; `certificate.certify`
proves it between the knots, too; `steps` says whether dt is short enough. Distances from obstacles, also between
knots, are those of `Distance.clearances`, and `contact` finds for pictures where they are below 0. Solvers may not be
imported here, nor kernels. It imports `problem`. Begin with `judge.py`.
"""
