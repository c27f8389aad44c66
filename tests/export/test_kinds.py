"""Every kind of rows, costs and models, and every number that may change, as exported C has them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import exported, needs_compiler
from tests.export.kinds import KINDS, START, N, car, point, reference
from tests.slow import mostly
from torchgco import (
    Boxes,
    ControlBounds,
    FunctionConstraint,
    Gates,
    InputError,
    Integral,
    OscillatingBoxes,
    Problem,
    Spheres,
    load_c,
)

pytestmark = [needs_compiler, pytest.mark.usefixtures("quickly")]
QUICK = "discs", "an implicit step", "boxes", "a function", "values", "a required goal"
# New numbers by name in Python, as shares of the old ones.
CHANGED = {
    "discs": {"centers": 1.02, "radii": 0.9, "Q": 1.1, "constraints[0].upper": 0.95, "x_ref": 1.01, "u_ref": 1.0},
    "values": {"target": 1.1, "drag": 0.5},
    "boxes": {"centers": 1.05, "R": 0.8},
    "moving spheres": {"velocities": 0.9, "centers": 1.1},
    "moved": {"places": 1.02},
    "a required goal": {"state": 1.05},
    "by knot": {"own_path": 1.05},
}


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compilers take a third of the time; bits don't depend on it."""
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-O1")


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning", "ignore::torchgco.HorizonWarning")
@pytest.mark.parametrize("kind", mostly(KINDS, *(set(KINDS) - set(QUICK))))
def test_steps_have_the_bits_of_python(kind: str, tmp_path: Path) -> None:
    problem = KINDS[kind]()
    c, compiled = load_c(exported(problem, tmp_path)), torchgco.compile(problem, "interior_point", receding=True)
    x, draws = problem.x0[0].numpy().copy(), np.random.default_rng(1)
    changes = {name: share * compiled.numbers[name][0] for name, share in CHANGED.get(kind, {}).items()}
    for k in range(6):
        numbers = changes if k == 3 else {}
        answer = compiled(x0=x, numbers=numbers)
        u = c.step(x, numbers={member(c.numbers, name): value for name, value in numbers.items()})
        assert torch.equal(u, answer.u[0]) and c.status == answer.statuses[0] == torchgco.Status.CONVERGED, k
        assert c.workspace.iterations == int(answer.iterations[0]) and bool(c.workspace.warm) == bool(answer.warm[0])
        x = answer.X[0, 1].numpy() + 1e-3 * draws.standard_normal(len(x))


def member(numbers: dict[str, np.ndarray], name: str) -> str:
    """The name of a number in C."""
    return next(
        word for word in (name.rpartition(".")[2], name.replace("[", "_").replace("].", "_")) if word in numbers
    )


@pytest.mark.slow
def test_only_chosen_numbers_change(tmp_path: Path) -> None:
    folder = exported(
        car(Spheres([[2.5, 0.6]], [0.3], 0.2)), tmp_path, "x_ref", "constraints[0].upper", "vehicle_radius"
    )
    c = load_c(folder)
    assert {name: value.shape for name, value in c.numbers.items()} == {
        "x_ref": (N + 1, 4), "upper": (2,), "vehicle_radius": (1,)
    }  # fmt: skip
    header = (folder / "car.h").read_text()
    assert "double upper[2]; /* 2: constraints[0].upper */" in header
    c.step(START, x_ref=reference(0.1))
    with pytest.raises(InputError, match="centers"):
        c.step(START, centers=[[2.5, 0.6]])
    with pytest.raises(InputError, match="x_ref"):
        c.step(START, x_ref=reference()[1:])


SWINGING = OscillatingBoxes(Boxes([[0.0, 0.6]], [[0.2, 0.1]], 0.1), [[[0.1, 0.2]]], [[[2.0, 1.0]]], [[[0.0, 0.5]]])
REFUSED = {
    "no element": (lambda: point().take([]), {}, "0 problems"),
    "horizons": (lambda: point(horizon=[8]), {}, "problem.horizon"),
    "gates in a loop": (lambda: point(Gates([[0.0, 0.1]], radius=0.3)), {}, "Gates"),
    "an integral": (lambda: point(Integral(lambda x, u: u.square().sum(-1), most=9.0)), {}, "Integral"),
    "single precision": (lambda: Problem(point().dynamics, point().cost, [ControlBounds(-8.0, 8.0)],
                                         torch.zeros(1, 4), N), {}, "double precision"),
    "a name": (point, {"name": "2fast"}, "word of C"),
    "a word of C": (point, {"name": "double"}, "word of C"),
    "an unknown number": (point, {"changes": ["nothing"]}, "nothing"),
    "x0": (point, {"changes": ["x0"]}, "x0"),
    "a computed number": (KINDS["boxes"], {"changes": ["half_sizes"]}, "half_sizes"),
    "a number": (lambda: 3, {}, "a Problem"),
    "boxes that swing": (lambda: point(SWINGING), {}, r"constraints\[1\].*numbers that say where"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_go_is_refused_by_name_before_a_file_is_written(what: str, tmp_path: Path) -> None:
    make, options, told = REFUSED[what]
    with pytest.raises(InputError, match=told):
        torchgco.export_c(make(), tmp_path / "folder", **options)
    assert not (tmp_path / "folder").exists()


@pytest.mark.parametrize("kind", ["moving spheres", "moved"])
def test_places_of_what_moves_can_change_in_a_loop(kind: str, tmp_path: Path) -> None:
    """As constants they would begin anew in every step; where the horizon stays, they are right."""
    places = {"moving spheres": "centers", "moved": "places"}[kind]
    for receding, asked in ((True, ["x_ref"]), (True, ["x_ref", places]), (False, ["x_ref"])):
        text = (torchgco.export_c(KINDS[kind](), tmp_path, "k", receding, asked) / "k.h").read_text()
        assert ["x_ref"] + [places] * receding == re.findall(r"double (\w+)\[\d+\]; /\* [\d x]+: ", text)
    assert torchgco.export_c(point(SWINGING), tmp_path, receding=False) == tmp_path


def test_functions_that_only_python_computes_are_refused(tmp_path: Path) -> None:
    def rows(x: torch.Tensor) -> torch.Tensor:
        return torch.lgamma(x[..., :1] + 10.0) - 100.0

    problem = point(FunctionConstraint(rows))
    with pytest.warns(Warning), pytest.raises(InputError, match="problem"):
        torchgco.export_c(problem, tmp_path / "folder")
    assert not (tmp_path / "folder").exists()


@pytest.mark.slow
def test_a_compiled_problem_is_exported_with_its_numbers(tmp_path: Path) -> None:
    compiled = torchgco.compile(car(), "interior_point", changes=["x0", "x_ref", "R"], receding=True)
    compiled.numbers["R"] = [[0.3, 2.0]]
    compiled(x0=START, x_ref=reference(0.4))
    c = load_c(torchgco.export_c(compiled, tmp_path, changes=["x_ref", "R"]))
    assert c.numbers["R"].ravel().tolist() == [0.3, 2.0] and np.array_equal(c.numbers["x_ref"], reference(0.4))
    fresh = torchgco.compile(compiled.problem, "interior_point")
    assert torch.equal(c.step(START), fresh(x0=START).u[0])
