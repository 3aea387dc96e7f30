"""What lies in deploy/ is taken by the tools that it is for, as far as these are here."""

import os
import re
import shlex
import shutil
import subprocess

import kubernetes_validate
import pytest
import yaml

from league.commands import cli
from league.commands.options import parse
from league.commands.run import join
from league.config import experiment as configuration
from league.system import exit_codes
from tests.league.conftest import ROOT

DEPLOY = ROOT / "deploy"
SLURM = (
    "ClusterName=x\nSlurmctldHost=127.0.0.1\nAuthType=auth/none\nMessageTimeout=1\nGresTypes=gpu\n"
    "NodeName=localhost CPUs=2\nPartitionName=all Nodes=ALL Default=YES\n"
)


def said(*call: object, **given) -> str:
    done = subprocess.run([*map(str, call)], capture_output=True, text=True, timeout=60, check=False, **given)
    return done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
@pytest.mark.parametrize("unit", ["league.service", "league-worker.service"])
def test_systemd_takes_its_units(unit, tmp_path):
    assert said("systemd-analyze", "verify", DEPLOY / unit) == ""
    broken = tmp_path / unit
    broken.write_text((DEPLOY / unit).read_text().replace("Restart=", "Restort="))
    assert "Restort" in said("systemd-analyze", "verify", broken)


@pytest.mark.parametrize(
    ("unit", "left"),
    [("league.service", {exit_codes.BAD_INPUT}), ("league-worker.service", {exit_codes.BAD_INPUT, exit_codes.UNFIT})],
)
def test_systemd_starts_again_what_may_pass_for_as_long_as_that_takes_and_leaves_the_rest_to_a_person(unit, left):
    settings = dict(re.findall(r"^(\w+)=(.*)$", (DEPLOY / unit).read_text(), re.MULTILINE))
    assert settings["Restart"] in ("on-failure", "always")
    assert set(map(int, settings["RestartPreventExitStatus"].split())) == left
    assert settings["StartLimitIntervalSec"] == "0"


def test_both_units_write_shared_blobs_as_the_same_user():
    for unit in ("league.service", "league-worker.service"):
        settings = (DEPLOY / unit).read_text().splitlines()
        assert {"User=robot-league", "ReadWritePaths=-/srv/robot-league"} <= set(settings)


def test_every_exit_code_is_told_in_the_help_and_in_the_docs(capsys):
    with pytest.raises(SystemExit):
        cli.main(["help"])
    told, page = capsys.readouterr().out, (ROOT / "docs" / "deploy.md").read_text()
    for code in exit_codes.MEANINGS:
        assert re.search(rf"^  {code} +\S", told, re.MULTILINE)
        assert f"| {code} |" in page


def test_the_script_for_slurm_is_one_of_bash():
    assert said("bash", "-n", DEPLOY / "league.sbatch") == ""


@pytest.mark.skipif(shutil.which("sbatch") is None, reason="no Slurm here")
def test_slurm_takes_its_script_as_far_as_it_can_without_a_controller(tmp_path):
    settings, script = tmp_path / "slurm.conf", tmp_path / "league.sbatch"
    settings.write_text(SLURM)
    text = (DEPLOY / "league.sbatch").read_text()
    for given, answer in ((text, "Unable to contact slurm controller"), (text.replace("--time=", "--tim="), "tim=")):
        script.write_text(given)
        assert answer in said(
            "sbatch", "--test-only", script, "league.toml", env={**os.environ, "SLURM_CONF": str(settings)}
        )


def manifests() -> list[dict]:
    return list(yaml.safe_load_all((DEPLOY / "league.yaml").read_text()))


def test_kubernetes_takes_its_manifests():
    for manifest in manifests():
        kubernetes_validate.validate(manifest, kubernetes_validate.latest_version(), strict=True)
    bad = manifests()[-1]
    bad["spec"]["replicaz"] = bad["spec"].pop("replicas")
    with pytest.raises(kubernetes_validate.ValidationError, match="replicaz"):
        kubernetes_validate.validate(bad, kubernetes_validate.latest_version(), strict=True)


def test_no_new_pod_needs_a_gpu_before_an_old_one_has_ended():
    for manifest in (each for each in manifests() if each["kind"] == "Deployment"):
        strategy = manifest["spec"]["strategy"]
        assert strategy.get("type") == "Recreate" or strategy["rollingUpdate"]["maxSurge"] == 0


def test_the_commands_that_they_start_are_ours_and_take_their_flags():
    started = [m["spec"]["template"]["spec"]["containers"][0]["args"] for m in manifests() if m["kind"] == "Deployment"]
    for name in ("league.service", "league-worker.service"):
        started += [shlex.split(line) for line in re.findall(r"ExecStart=\S+ (.*)", (DEPLOY / name).read_text())]
    script = (DEPLOY / "league.sbatch").read_text()
    started += [shlex.split(line) for line in re.findall(r"^ +(?:exec )?(league .*)", script, re.MULTILINE)]
    assert len(started) == 6
    for program, command, *args in started:
        assert (program, command in cli.COMMANDS) == ("league", True)
        if command == "worker":
            assert parse(join.WorkerOptions, args, "worker", "").wait
        else:
            settings = manifests()[0]["data"]["league.toml"]
            assert [word for word in args if word.startswith("--")] == ["--store"]
            assert configuration.loads(settings).league == "main"
