# SPDX-License-Identifier: Apache-2.0
"""Execute the notebooks of docs/ and write them as pages."""

import os
import re
import sys
import tempfile
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

LIMIT_S: Final = 900
EXTRAS: Final = ("torch",)  # that a notebook may need and a checkout may lack


def pages(folder: Path, scratch: Path) -> dict[str, str | bytes]:
    """Run each notebook in an empty folder, and return its page and pictures by their paths.

    A cell that fails ends the build with its error. With `DOCS_RUN=0` the notebook is shown without its outputs, and so
    is one that imports an extra that is missing; its page then begins with a word on it.
    """
    import jupytext  # noqa: PLC0415 - in the group `docs`
    from jupyter_client.manager import AsyncKernelManager  # noqa: PLC0415 - as above
    from nbclient import NotebookClient  # noqa: PLC0415 - as above
    from nbconvert import MarkdownExporter  # noqa: PLC0415 - as above
    from nbformat.v4 import new_markdown_cell  # noqa: PLC0415 - as above

    made: dict[str, str | bytes] = {}
    for path in sorted(folder.glob("*.py")):
        notebook = jupytext.read(path)
        lacking = [name for name in EXTRAS if f"import {name}\n" in path.read_text("utf-8") and find_spec(name) is None]
        if lacking:
            word = f"*Not run when this page was built, because `{lacking[0]}` is not installed: outputs are left out.*"
            notebook.cells.insert(1, new_markdown_cell(word))
        elif os.environ.get("DOCS_RUN") != "0":
            scratch.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=scratch) as home, tempfile.TemporaryDirectory() as sockets:
                # Sockets in a private folder, not ports; their paths must be short.
                kernel = AsyncKernelManager(kernel_name="python3", transport="ipc", ip=f"{sockets}/kernel")
                program = Path(sys.executable).parent  # where the commands of this environment are
                own = {"PATH": f"{program}:{os.environ['PATH']}", "IPYTHONDIR": sockets}
                place = {"metadata": {"path": home}}
                client = NotebookClient(notebook, timeout=LIMIT_S, km=kernel, resources=place)
                client.execute(env=os.environ | own)
        for cell in (cell for cell in notebook.cells if cell.cell_type == "code"):
            cell["outputs"] = _joined(item for item in cell.get("outputs", ()) if item.get("name") != "stderr")
        text, resources = MarkdownExporter().from_notebook_node(notebook)
        made[f"notebooks/{path.stem}.md"] = re.sub(r"^```\w+\n%%bash -e\n", "```bash\n", text, flags=re.MULTILINE)
        made |= {f"notebooks/{name}": content for name, content in resources["outputs"].items()}
    return made


def _joined(outputs: Iterable[Any]) -> list[Any]:
    """Return outputs with the pieces of what was printed put together."""
    joined: list[Any] = []
    for item in outputs:
        if joined and item.output_type == joined[-1].output_type == "stream":
            joined[-1].text += item.text
        else:
            joined.append(item)
    return joined
