"""The notebook that goes from a recording to a better model runs, and what it shows is stored in it."""

import importlib.util
import json
from pathlib import Path

import pytest

from drivelink import jointfile

ROOT = Path(__file__).parents[1]


def runner():
    spec = importlib.util.spec_from_file_location("docs_notebook", ROOT / "docs" / "notebook.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_notebook_finds_the_effect_and_its_outputs_are_stored(tmp_path):
    made = runner()
    stored = json.loads(made.NOTEBOOK.read_text(encoding="utf-8"))
    executed, names = made.execute(made.NOTEBOOK, tmp_path)
    (effect,) = names["outcome"].effects
    assert (effect.name, effect.motor) == ("coulomb_friction", 0)
    assert effect.parameters["torque_nm"] == pytest.approx(0.004, rel=0.05)  # as it was switched on
    errors = names["outcome"].validation
    assert errors.after_rms_nm < 0.2 * errors.before_rms_nm
    files = (jointfile.load(names[name]) for name in ("elbow", "better"))
    fitted, better = ([one.name for one in file.motor[0].effect] for file in files)
    assert better == [*fitted, "coulomb_friction"]  # to what the fit wrote, the diagnosis adds one effect
    for cell, fresh in zip(stored["cells"], executed["cells"], strict=True):
        shown = [[sorted(out.get("data", ())) for out in one.get("outputs", ())] for one in (cell, fresh)]
        assert shown[0] == shown[1], "run python docs/notebook.py"
