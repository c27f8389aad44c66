"""The text of the page: one file, nothing from outside, nothing of the data that a browser would run."""

from __future__ import annotations

import hashlib
import re
from html.parser import HTMLParser

import pytest
import torch

from tests.view.scenes import WORDS, document, problem, solution, trajectories
from torchgco import FunctionDynamics, InputError, Problem, QuadraticCost, Solution
from torchgco.base.html import HtmlPage
from torchgco.view.page import MODULES, STATIC, THREE, page

# As the npm package three 0.185.1 has them in its folder `build`.
BUILT = {
    "three.core.min.js": "05b2609338c76cd65daf74f3ac515bc9a5045e1b3b33edc07d8c9bd55250fa90",
    "three.module.min.js": "86bcee248b64f44bcfc23c331ae74619061957d59cab040171dcb6fb5900beb6",
}


class Elements(HTMLParser):
    """The elements of a page: name and attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


@pytest.fixture(scope="module")
def text() -> str:
    return page(document())


@pytest.fixture(scope="module")
def held() -> tuple[Problem, Solution]:
    task = problem(2)
    return task, solution(task, trajectories(2)["gco"])


def test_the_page_asks_for_nothing(text: str) -> None:
    for tag, attributes in Elements(text).found:
        assert not {"src", "href", "srcset", "action"} & attributes.keys(), (tag, attributes)
    (policy,) = (a["content"] for _, a in Elements(text).found if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and policy.startswith("default-src 'none'") and "connect-src" not in policy
    assert "http" not in policy and "*" not in policy


def test_words_of_the_data_are_text(text: str) -> None:
    tags = [tag for tag, _ in Elements(text).found]
    assert "img" not in tags and WORDS not in text
    assert text.count("</script>") == tags.count("script")
    for name in MODULES:
        source = (STATIC / name).read_text()
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b", source), name


def test_each_module_imports_from_those_before_it() -> None:
    known = set(BUILT)
    for name in MODULES:
        imported = re.findall(r'from\s*"\./([\w.]+)"', (STATIC / name).read_text())
        assert set(imported) <= known, name
        known.add(name)
    assert known - set(BUILT) == {path.name for path in STATIC.glob("*.js")} - {"boot.js"}


def test_three_is_as_its_authors_built_it(text: str) -> None:
    for name, digest in BUILT.items():
        assert hashlib.sha256((THREE / name).read_bytes()).hexdigest() == digest
    assert "three.js 0.185.1" in text and "The MIT License" in text


def test_every_control_has_a_name(text: str) -> None:
    labels = re.findall(r"<label[^>]*>(.*?)</label>", text, re.DOTALL)
    for tag, attributes in Elements(text).found:
        if tag in ("select", "input", "button", "canvas", "aside", "section", "footer"):
            name = attributes.get("id") or ""
            inside = any(f'id="{name}"' in label for label in labels) if name else False
            written = re.search(rf'<button id="{name}"[^>]*>\w+', text) is not None
            assert inside or written or {"aria-label", "aria-labelledby"} & attributes.keys(), (tag, attributes)


def test_a_solution_is_shown_and_saved(held: tuple[Problem, Solution], tmp_path) -> None:
    task, found = held
    shown = found.show(task)
    assert isinstance(shown, HtmlPage) and len(repr(shown)) < 100
    frame = shown._repr_html_()
    ((tag, attributes),) = Elements(frame).found
    assert tag == "iframe" and attributes["srcdoc"] == shown.html and attributes["title"]
    assert shown.save(tmp_path / "one.html").read_text() == shown.html
    assert len(shown.html) < 5e5


def test_what_cannot_be_shown_is_refused(held: tuple[Problem, Solution]) -> None:
    task, found = held
    with pytest.raises(InputError, match=r"solution\.X"):
        found.show(task.take(torch.tensor([0])))
    with pytest.raises(InputError, match="at least one problem"):
        none = task.take(torch.tensor([], dtype=torch.int64))
        Solution.empty(none).show(none)
    swing = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), n=2, m=1, dt=0.1)
    still = Problem(swing, QuadraticCost(Q=[1.0, 0], R=[1.0], Qf=[1.0, 0], x_ref=[0, 0]), [], task.x0[:, :2], 5)
    with pytest.raises(InputError, match="a model with a position"):
        solution(still, task.x0.new_zeros(2, 6, 2), task.x0.new_zeros(2, 5, 1)).show(still)


def test_numbers_in_a_page_of_states_that_are_lost() -> None:
    task, X = problem(1), trajectories(1)["gco"]
    X[:, 3:] = torch.nan
    assert "part-0" in solution(task, X).show(task).html
