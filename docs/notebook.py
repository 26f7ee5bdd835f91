"""Executes examples/better_model.ipynb and stores what its cells show.

Run `python docs/notebook.py` after a change of the notebook or of what it calls. A test executes it, too.
"""

import ast
import base64
import contextlib
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

NOTEBOOK = Path(__file__).parents[1] / "examples" / "better_model.ipynb"


def execute(path: Path, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run the cells in order, in the given folder, as a Jupyter kernel would.

    Returns:
        The notebook with what its cells show, and the names that they have made.
    """
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    names: dict[str, Any] = {"__name__": "__main__"}
    before, search = Path.cwd(), sys.path.copy()
    os.chdir(folder)
    sys.path.insert(0, str(path.parent))
    try:
        code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        for number, cell in enumerate(code, start=1):
            cell["execution_count"] = number
            cell["outputs"] = _outputs("".join(cell["source"]), number, names)
    finally:
        os.chdir(before)
        sys.path[:] = search
    return notebook, names


def _outputs(source: str, number: int, names: dict[str, Any]) -> list[dict[str, Any]]:
    """What a cell prints, and what its last line is."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    printed, where = io.StringIO(), f"<cell {number}>"
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, where, "exec"), names)
        shown = eval(compile(ast.Expression(last.value), where, "eval"), names) if last else None
    made: list[dict[str, Any]] = []
    if printed.getvalue():
        made.append({"output_type": "stream", "name": "stdout", "text": _lines(printed.getvalue())})
    if shown is not None:
        data: dict[str, Any] = {"text/plain": _lines(repr(shown))}
        if hasattr(shown, "_repr_png_"):
            data = {"text/plain": ["a figure"]}
            data["image/png"] = base64.b64encode(shown._repr_png_()).decode()
        made.append(
            {"output_type": "execute_result", "execution_count": number, "data": data, "metadata": {}}
        )
    return made


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def main() -> None:
    """Execute the notebook in a folder of its own and store the outputs."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        notebook, _ = execute(NOTEBOOK, Path(folder))
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
