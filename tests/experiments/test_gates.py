"""A study of a race: its times are kept, confirmed, exported and shown."""

import numpy as np
import pandas as pd
import pytest

from torchgco.experiments.reports.export import write_export
from torchgco.experiments.reports.verify import verify_study


@pytest.mark.slow
def test_a_study_keeps_the_times(run, tmp_path) -> None:
    words = ["scenario=race", "scenario.gates=[[-1.1,-1.6,3.6],[9.2,6.6,1.0]]", "scenario.stages=6", "study.layouts=2",
             "study.baselines=[]", "study.view=true", "study.workers=1", "hydra.run.dir=study"]  # fmt: skip
    code, _, err = run(*words)
    assert code == 0, err
    folder = tmp_path / "study"
    trials = pd.read_parquet(folder / "trials.parquet")
    assert trials["reached"].all() and trials["gates_passed"].tolist() == [2, 2]
    with np.load(folder / "solutions.npz") as held:
        times, U = held["times"][0], held["U"][0]
    np.testing.assert_allclose(times[:, -1], trials["duration"])
    lengths = np.diff(times, axis=1).reshape(2, 3, 6)
    np.testing.assert_allclose(lengths, lengths[..., :1] * np.ones(6))
    assert U.shape == (2, 18, 4) and (np.ptp(lengths[..., 0], axis=1) > 1e-3).all()
    assert not verify_study(folder).differs
    table = pd.read_csv(write_export(folder, layouts=[1])[0])
    np.testing.assert_allclose(table["t [s]"], times[1])
    assert (folder / "figures" / "layouts.png").is_file() and (folder / "view.html").is_file()
