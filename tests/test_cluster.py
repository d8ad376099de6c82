"""The files for clusters: SLURM's by bash and by what its options may be, Kubernetes' by its own schema."""

import re
import shutil
import subprocess
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from ditr_lite.cli import parser

CLUSTER = Path(__file__).resolve().parents[1] / "tools" / "cluster"
SBATCH, JOB = CLUSTER / "train.sbatch", CLUSTER / "train.yaml"
# of sbatch's manual, those that a training needs
OPTIONS = {"job-name", "nodes", "ntasks-per-node", "gres", "cpus-per-task", "mem", "time", "requeue", "open-mode"}
OPTIONS |= {"output"}


def resources():
    return list(yaml.safe_load_all(JOB.read_text(encoding="utf-8")))


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_the_slurm_file_is_a_script_with_options_in_front():
    subprocess.run(["bash", "-n", str(SBATCH)], check=True)
    lines = SBATCH.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#!/bin/bash"
    options = [line for line in lines if line.startswith("#SBATCH")]
    first_command = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    assert max(i for i, line in enumerate(lines) if line in options) < first_command  # sbatch stops reading there
    names = [re.fullmatch(r"#SBATCH --([a-z-]+)(=\S+)?", line).group(1) for line in options]
    assert set(names) == OPTIONS and len(names) == len(OPTIONS)
    text = "\n".join(lines)
    assert re.search(r"--gres=gpu:(\d+)", text).group(1) == re.search(r"^GPUS=(\d+)", text, re.MULTILINE).group(1)


@pytest.mark.parametrize("k", [0, 1])
def test_the_kubernetes_file_fits_the_schema(k):
    kubernetes_validate.validate(resources()[k], "1.30", strict=True)


def test_a_wrong_field_is_noticed_by_the_schema():
    job = resources()[1]
    job["spec"]["completion"] = 2
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(job, "1.30", strict=True)


def test_the_pods_find_each_other_by_the_services_name():
    service, job = resources()
    pod = job["spec"]["template"]["spec"]
    name = service["metadata"]["name"]
    assert pod["subdomain"] == name == job["metadata"]["name"] == service["spec"]["selector"]["job-name"]
    [command] = pod["containers"][0]["args"]
    assert f"--master-addr={name}-0.{name} " in command and f"--nnodes={job['spec']['completions']} " in command
    assert f"--master-port={service['spec']['ports'][0]['port']} " in command


def commands():
    yield SBATCH.read_text(encoding="utf-8")
    yield from resources()[1]["spec"]["template"]["spec"]["containers"][0]["args"]


@pytest.mark.parametrize("text", list(commands()), ids=["slurm", "kubernetes"])
def test_what_they_start_is_a_command_of_ours(text):
    words = text.split("-m ditr_lite ")[-1].replace('"$@"', "").split()
    options = parser().parse_args(words)
    assert options.workers == 3 and options.work
