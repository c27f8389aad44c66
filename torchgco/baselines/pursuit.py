"""A grid path, pursued by a simple controller, and the interior point: what anyone would try first among obstacles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import put, take
from torchgco.baselines.drivers import BRAKING, Driver, Track, driver_of, own_model
from torchgco.lagrangian.lagrangian import Iterate, SolveEnd
from torchgco.maps.ways import Ways, length
from torchgco.obstacles.base import ADMITTED
from torchgco.obstacles.body import check_no_body
from torchgco.problem.problem import Problem
from torchgco.roadmap.clear import evenly, smoothed
from torchgco.roadmap.geometry import Scene, scene_of
from torchgco.search.finish import cleared, serving
from torchgco.search.tube import radius_of
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Solver
from torchgco.solvers.interior import InteriorPoint, guessed, least_violated
from torchgco.solvers.session import Session

Array = NDArray[np.float64]

GRID_SPACING = 0.5  # radii between nodes of the grid, at most
GRID_NODES = 2**18  # of a grid, about, at most: a search of as many takes a second
LEAST_NODES = 2**14  # and where there is no radius to go by
PATH_SPACING = 0.25  # radii between the points of a path
NEAR = 2.0  # radii from contact within which a way costs more
NEARNESS = 2.0  # at contact a metre costs so much more
SMOOTHING = 2.0  # radii, the standard deviation of the Gaussian that rounds a path's corners
LOOKAHEAD = 2.4  # radii that the controller looks ahead along the path
DRIVEN = 0.75  # share of the horizon in which the path is driven
ROUNDS = 4  # of solves with larger obstacles at most
GRID_REACH = 4.0  # radii that the grid reaches beyond start, goal and obstacles


@dataclass(frozen=True)
class PathPursuit(Solver, named="solver"):
    """The shortest way over a grid, pursued, and the result solved by the interior point with a small barrier.

    Where the trajectory touches an obstacle between two knots, obstacles grow by what is missing and the interior point
    goes on. One problem's guess after the other; for a `Unicycle`, and for models whose position can be pushed in every
    direction (points). The recipe uses nothing of `gco`'s search.

    Args:
        solver: solves each problem from the trajectory along its path, and, by its `warm_barrier`, again where the
            result touches an obstacle between knots.

    Raises:
        InputError: a field out of its range; on `solve`, other models, no goal, obstacles that move or of kinds that no
            path is sought among.
    """

    solver: InteriorPoint = InteriorPoint(max_iterations=3000, initial_barrier=1e-3, warm_barrier=1e-4)

    def announce(self, problem: Problem) -> None:
        """As the interior point."""
        self.solver.announce(problem)

    def run(self, call: Call) -> Solution:
        """Find a path for each problem, pursue it, and solve."""
        session, admitted = Session(call, own_units=True), self.solver.admitted(call.problem)
        scaled = session.call
        U, has_path = self.guess(scaled.problem, scaled.U0, call)
        scaled = replace(scaled, U0=U)
        guess = guessed(scaled)
        end = self._cleared(scaled, self.solver.no_worse(scaled, guess, self.solver.solved(scaled, guess=guess)))
        solution = session.finished(least_violated(scaled, end, admitted), admitted)
        return replace(solution, guided=has_path.long())

    def guess(self, problem: Problem, U0: Tensor, call: Call | None = None) -> tuple[Tensor, Tensor]:
        """Controls (B, N, m) along the paths, and where (B,) there is one; else U0.

        Args:
            call: whose time may be over before all paths are sought.

        Raises:
            InputError: as the class says.
        """
        driver, scene = self._checked(problem)
        U, has_path = U0.clone(), torch.zeros_like(problem.x0[:, 0], dtype=torch.bool)
        sound = problem.start_is_clear & torch.isfinite(problem.x0).all(-1)
        for b in sound.nonzero().flatten().tolist():
            if call is not None and call.late:
                break
            row = torch.tensor([b], device=problem.x0.device)
            single = problem.take(row)
            track = self._track(single, None if scene is None else scene.take(row))
            if track is not None:
                last = int(single.stages[0])
                U[b, :last], has_path[b] = U.new_tensor(driver(single, track)[:last]), True
        return U, has_path

    def _checked(self, problem: Problem) -> tuple[Driver, Scene | None]:
        """The controller, and start, goal and obstacles; None where there are no obstacles."""
        if problem.dynamics.position is None or (driver := driver_of(problem)) is None:
            expected = "a Unicycle, or a model whose position can be pushed in every direction, for path_pursuit"
            raise InputError("problem.dynamics", expected, type(own_model(problem.dynamics)).__name__)
        if problem.goal is None:
            raise InputError("problem.goal", "a Goal, to which path_pursuit seeks a way", "none")
        check_no_body(problem, "vehicle_radius", "a number for path_pursuit, whose vehicle is a ball")
        rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
        scene = scene_of(problem, rest)
        if scene is None and problem.obstacles:
            kinds = ", ".join(type(obstacle).__name__ for obstacle in problem.obstacles)
            raise InputError("problem.constraints", "obstacles at rest, of kinds that path_pursuit knows", kinds)
        return driver, scene

    def _track(self, problem: Problem, scene: Scene | None) -> Track | None:
        """What to pursue in a batch of one; None where there is no way, or nowhere to go."""
        assert problem.goal is not None
        R, ends = radius_of(problem), (problem.x0[:, problem.position], problem.goal.position)
        start, goal = (p[0].double().cpu().numpy() for p in ends)
        way = np.stack((start, goal)) if scene is None else self._way(problem, scene, start, goal, R)
        if way is None or length(way) <= 0.0:
            return None
        long, duration = length(way), float(problem.stages[0]) * float(problem.dynamics.dt)
        unit = R or long / 100.0
        step = min(PATH_SPACING * unit, long / 10.0)
        points = smoothed(evenly(way, step), SMOOTHING * unit / step)
        speed = length(points) / (DRIVEN * duration)
        braking = speed / (BRAKING * duration)
        return Track(points, step, max(1, round(LOOKAHEAD * unit / step)), speed, braking)

    def _way(self, problem: Problem, scene: Scene, start: Array, goal: Array, R: float) -> Array | None:
        """The cheapest way (P, d) over a grid, first by steps that are free for the vehicle, then by nodes that are."""
        low, high = region(scene, GRID_REACH * R)
        wide, d = high - low, len(low)
        least = float(np.prod(wide) / GRID_NODES) ** (1.0 / d)
        spacing = max(GRID_SPACING * R, least) if R > 0 else float(np.prod(wide) / LEAST_NODES) ** (1.0 / d)
        axes = [torch.arange(int(side / spacing) + 1, dtype=torch.float64) for side in wide]
        nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        places = problem.x0.new_tensor(low) + spacing * nodes.to(problem.x0)
        away = clearance(problem, places.reshape(1, -1, d)).reshape(nodes.shape[:-1]).double().cpu().numpy()
        near = NEAR * (R or spacing)
        for depth in (0.0, 0.5 * spacing * d**0.5):
            way = Ways(away, low, spacing, -depth, near + depth, NEARNESS).way(start, goal)
            if way is not None:
                return way
        return None

    def _cleared(self, call: Call, end: SolveEnd) -> SolveEnd:
        """The same, solved again with grown obstacles where trajectories touch one between two knots.

        As `ClearChords`, but by the interior point alone: a new trajectory is kept where it is feasible among obstacles
        as they are, arrives where the old one did, and keeps more clearance.
        """
        problem, best = call.problem, end.best

        def once(rows: Tensor, grown: Call, old: Iterate, least: Tensor) -> tuple[Tensor, Tensor]:
            new = self.solver.solved(replace(grown, callback=None), old.X)
            end.iterations[rows] += new.iterations
            serves, iterates, clearance = serving(problem.take(rows), new.best, old, least, ADMITTED)
            kept = serves.nonzero().flatten()
            put(best, rows[kept], take(iterates, kept))
            end.status[rows[kept]] = new.status[kept]
            return serves, clearance

        if problem.obstacles:
            cleared(call, best, ROUNDS, ADMITTED, once)
        return end


def region(scene: Scene, margin: float) -> tuple[Array, Array]:
    """The corners (d,) of the space in which a way is sought, in a scene of one."""
    low, high = (corner[0].double().cpu().numpy() for corner in scene.obstacles.region(scene.start, scene.goal))
    for obstacle in scene.obstacles.maps:
        which = int(obstacle.which[0])
        low, high = np.minimum(low, obstacle.field.origin[which]), np.maximum(high, obstacle.field.upper[which])
    return low - margin, high + margin


def clearance(problem: Problem, points: Tensor) -> Tensor:
    """Clearances (K,) at points (1, K, d) from all obstacles of a batch of one, m."""
    nearest = torch.full_like(points[0, :, 0], torch.inf)
    for obstacle in problem.obstacles:
        if obstacle.margins.shape[1] > 0:
            away = obstacle.signed_distance(points, points.new_zeros(points.shape[1]))[0]
            nearest = torch.minimum(nearest, away.masked_fill(obstacle.absent[0], torch.inf).amin(-1))
    return nearest
