"""Imports go one way through the layers, `import torchgco` stays light, and files and functions stay short."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "torchgco"
LAYERS = [
    ["base"],
    ["tracing", "dynamics", "costs", "constraints"],
    ["obstacles"],
    ["maps"],
    ["problem"],
    ["lagrangian", "judging"],
    ["ilqr"],
    ["eager"],
    ["explaining"],
    ["solution", "native"],
    ["kernels"],
    ["solvers", "roadmap", "receding"],
    ["sensitivity"],
    ["guidance", "missions", "scenarios"],
    ["search", "plotting", "exploration"],
    ["view"],
    ["baselines"],
    ["presets"],
    ["fleets", "guesses", "tightened", "warned"],
    ["phases"],
    ["api", "envs", "pictures"],
    ["compiled"],
    ["export"],
    ["experiments"],
]
MODULES = sorted(
    p for p in PACKAGE.rglob("*.py") if (p.name != "__main__.py" and p.parent != PACKAGE) or p.stem != "__init__"
)


def layer_of(name: str) -> tuple[int, str]:
    """Layer and package of a module; of several matching packages, the one with the longest name."""
    entries = [(level, package) for level, packages in enumerate(LAYERS) for package in packages]
    for level, package in sorted(entries, key=lambda pair: -len(pair[1])):
        if name == package or name.startswith(f"{package}."):
            return level, package
    raise AssertionError(f"{name} is in no layer")


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text())))


def imports_of(path: Path) -> set[str]:
    names = set()
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("torchgco"):
            names.add(node.module.removeprefix("torchgco").removeprefix("."))
    return (names | imported_by_name(path)) - {""}


def imported_by_name(path: Path) -> set[str]:
    """Modules of torchgco that a file names in a string, as `import_module` takes them."""
    texts = (node.value for node in nodes_of(path) if isinstance(node, ast.Constant) and isinstance(node.value, str))
    named = {text.removeprefix("torchgco.") for text in texts if re.fullmatch(r"torchgco(\.\w+)+", text)}
    return {name for name in named if module_of(name)}


def module_of(name: str) -> bool:
    """Whether torchgco has a module of this name."""
    path = PACKAGE.joinpath(*name.split("."))
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def modules_of(path: Path) -> set[str]:
    """All modules that a file may import: each imported name may be a module itself."""
    froms = [node for node in nodes_of(path) if isinstance(node, ast.ImportFrom) and node.module]
    named = {f"{node.module}.{alias.name}" for node in froms for alias in node.names} | {node.module for node in froms}
    return {name.removeprefix("torchgco.") for name in named if name.startswith("torchgco.")} | imported_by_name(path)


def test_imports_go_one_way() -> None:
    for path in (path for path in MODULES if path != PACKAGE / "__main__.py"):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")
        level, package = layer_of(name)
        for imported in imports_of(path):
            other, other_package = layer_of(imported)
            parts = {package.split(".")[0], other_package.split(".")[0]} <= {"dynamics", "costs", "constraints"}
            assert other < level or other_package == package or parts, f"{name} imports {imported}"


def test_no_files_import_each_other_in_a_circle() -> None:
    """Imports for type checkers count too."""
    names = {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in MODULES}
    known = {name: modules_of(path) & set(names) - {name} for name, path in names.items()}
    while leaves := [name for name, others in known.items() if not others]:
        known = {name: others - set(leaves) for name, others in known.items() if name not in leaves}
    assert not known


def test_solvers_import_no_guidance_and_problems_no_solver() -> None:
    for path in (PACKAGE / "solvers").glob("*.py"):
        assert not any(name.startswith(("guidance", "search")) for name in imports_of(path)), path
    for package in ("dynamics", "costs", "constraints"):
        for path in (PACKAGE / package).glob("*.py"):
            assert not any(name.startswith(("solvers", "lagrangian", "guidance")) for name in imports_of(path)), path


def test_the_interface_of_obstacles_knows_no_kind_of_them() -> None:
    names = imports_of(PACKAGE / "obstacles" / "base.py")
    assert names and not any(name.startswith("obstacles") for name in names - {"obstacles.shapes"})


def test_only_experiments_import_hydra() -> None:
    for path in PACKAGE.rglob("*.py"):
        if "experiments" not in path.relative_to(PACKAGE).parts:
            text = path.read_text()
            assert "import hydra" not in text and "omegaconf" not in text, path


def test_no_slow_module_is_loaded_before_it_is_needed() -> None:
    """CasADi need not even be there. A study's worker imports the command, and must not load plotting either."""
    code = (
        "import sys, torch; sys.modules['casadi'] = None  # whoever imports it gets an ImportError\n"
        "loaded = lambda *names: print([m for m in names if m in sys.modules])\n"
        "import torchgco, torchgco.baselines; from torchgco.tracing import Traced\n"
        "loaded('hydra', 'matplotlib', 'pandas', 'scipy.ndimage', 'scipy.optimize', 'scipy.spatial')\n"
        "for model in (torchgco.QuadrotorPlanning(), torchgco.QuadrotorPlant()):\n"
        "    x, u = torch.zeros(1, model.n), torch.zeros(1, model.m)\n"
        "    Traced('step', lambda i, x, u: model.step(x, u), x, u).fingerprint()\n"
        "loaded('sympy', 'torch._dynamo')\n"
        "from torchgco.experiments import app; from torchgco.experiments.flying import flight\n"
        "loaded('matplotlib', 'scipy.stats')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.split() == ["[]"] * 3


def test_instantiate_is_called_in_one_place() -> None:
    places = [path.name for path in PACKAGE.rglob("*.py") if "utils.instantiate(" in path.read_text()]
    assert places == ["build.py"]


def test_c_and_the_files_of_the_page_are_short() -> None:
    for path in PACKAGE.rglob("*.[ch]"):
        assert len(path.read_text().splitlines()) <= 600, path
    for path in (PACKAGE / "view" / "static").iterdir():
        lines = path.read_text().splitlines()
        assert len(lines) <= 450 and max(map(len, lines)) <= 140, path


def test_docstrings_list_arguments_in_sections() -> None:
    """As Google's style has them: names in columns would be run together by the API reference."""
    rooms = ("experiments", "plotting", "scenarios", "view")
    for path in (path for room in rooms for path in (PACKAGE / room).rglob("*.py")):
        for node in nodes_of(path):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                lines = (ast.get_docstring(node) or "").splitlines()
                assert not [line for line in lines if re.match(r"[\w<>]+(, [\w<>]+)* {2,}\S", line)], path


def test_files_and_functions_are_short() -> None:
    for path in MODULES:
        assert len(path.read_text().splitlines()) <= 450, path
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno <= 65, f"{node.name} in {path.name}"


# Files of the package that name a kind, at most: what else there is to know of it, the kind says itself.
NAMED_IN = 6
ROOMS_OF_KINDS = "constraints", "obstacles", "costs", "maps/field.py", "problem/goal.py"


def test_frozen_objects_are_set_where_they_are_made() -> None:
    """`object.__setattr__` fills an object's own fields, or those of one that the same function has just made."""
    called_by_post_init = {"base/options.py", "exploration/sensing/sensors.py"}
    foreign = []
    for path in (path for path in MODULES if path.relative_to(PACKAGE).as_posix() not in called_by_post_init):
        tree = ast.parse(path.read_text())
        for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
            given = {argument.arg for argument in ast.walk(function.args) if isinstance(argument, ast.arg)} - {"self"}
            made = {
                name.id for name in ast.walk(function) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
            }
            for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
                if ast.unparse(call.func) == "object.__setattr__" and ast.unparse(call.args[0]) in given - made:
                    foreign.append(f"{path.relative_to(PACKAGE)}: {ast.unparse(call)}")
    assert not foreign


def test_kinds_are_known_in_few_files() -> None:
    kinds = set[str]()
    for path in MODULES:
        if str(path.relative_to(PACKAGE)).startswith(ROOMS_OF_KINDS):
            classes = (node for node in nodes_of(path) if isinstance(node, ast.ClassDef))
            kinds |= {node.name for node in classes if "bind" in {getattr(part, "name", "") for part in node.body}}
    kinds |= {"BoundSpheres", "BoundBoxes", "BoundField", "BoundOscillatingBoxes", "ControlBounds", "StateBounds"}
    assert len(kinds) > 20
    files: dict[str, set[str]] = {kind: set() for kind in kinds}
    for path in MODULES:
        for node in nodes_of(path):
            named = [a.name for a in node.names] if isinstance(node, ast.ImportFrom) else [getattr(node, "id", "")]
            for name in kinds.intersection(named):
                files[name].add(str(path.relative_to(PACKAGE)))
    bases = {"Constraint", "Cost", "Distance", "Obstacles", "OwnKind", "Vectors", "Bounds"}
    many = {kind: sorted(found) for kind, found in files.items() if len(found) > NAMED_IN}
    assert not {kind: found for kind, found in many.items() if kind not in bases}
