"""The quadrotor among spheres as a user of pytorch-mppi writes it: batched torch over states (K, 14).

Written for speed: few operations, each on all samples, distances by one matrix product.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.problem import Problem


class QuadrotorAmongSpheres:
    """Dynamics and running cost of the first problem of a batch, in single precision.

    Args:
        problem: quadrotor planning problems (Euler) with a diagonal quadratic cost and static spheres.
        collision_penalty: cost per obstacle touched.

    Raises:
        ValueError: two different time constants, or another integrator.
    """

    def __init__(self, problem: Problem, collision_penalty: float) -> None:
        cast = lambda value: value.float().contiguous()
        cost, model = problem.cost, problem.dynamics
        spheres = next(c for c in problem.constraints if isinstance(c, BoundSpheres))
        self.dt, self.collision_penalty = model.dt, collision_penalty
        self.lag = self.dt / model.rate_time_constant
        if model.rate_time_constant != model.thrust_time_constant or model.integrator != "euler":
            raise ValueError("written for one time constant of rates and thrust, and for Euler steps")
        self.fall = cast(problem.x0.new_tensor([0.0, 0.0, model.airframe.gravity]) * self.dt)
        self.x_ref, self.u_ref = cast(cost.x_ref[0, 0]), cast(cost.u_ref[0, 0])
        self.half_Q, self.half_R = cast(0.5 * cost.Q[0, 0]), cast(0.5 * cost.R[0, 0])
        centers, contact = spheres.centers[0], spheres.inflated_radii[0]
        self.twice_centers = cast(2 * centers.mT)  # (3, M)
        self.offset = cast(contact.square() - centers.square().sum(-1))  # (M,)
        self.one3, self.ones = torch.ones_like(self.fall), torch.ones_like(self.offset)

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        """The states (K, 14) after one step from x (K, 14) with u (K, m)."""
        p, v, q, rest = x[:, :3], x[:, 3:6], x[:, 6:10], x[:, 10:]
        q0, q1, q2, q3 = q.unbind(1)
        axis = torch.stack((2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3), 1)
        w, qv = rest[:, :3], q[:, 1:]
        turn = torch.cat((-(qv * w).sum(1, keepdim=True), q[:, :1] * w + torch.linalg.cross(qv, w)), 1)
        lift = rest[:, 3:] * axis
        return torch.cat(
            (p + self.dt * v, v + self.dt * lift - self.fall, q + 0.5 * self.dt * turn, rest + self.lag * (u - rest)), 1
        )

    def running_cost(self, x: Tensor, u: Tensor) -> Tensor:
        """Quadratic cost and collisions (K,)."""
        cost = (x - self.x_ref).square() @ self.half_Q + (u - self.u_ref).square() @ self.half_R
        return cost + self.collision_penalty * self.hits(x)

    def hits(self, x: Tensor) -> Tensor:
        """Spheres touched (K,): r^2 - |o|^2 + 2 o'p > |p|^2."""
        p = x[:, :3]
        inside = torch.addmm(self.offset, p, self.twice_centers) > (p.square() @ self.one3).unsqueeze(1)
        return inside.to(x.dtype) @ self.ones
