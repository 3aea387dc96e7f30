"""Diagnosis of this machine for `league doctor`: what is there, what is missing, and the command that brings it."""

import re
import shutil
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal, NamedTuple

from league.system import devices, environment
from league.system.memory import machine
from league.system.packages.displaced import displaced_package
from league.system.packages.versions import versions

State = Literal["ok", "optional", "slow", "missing"]

LEAST_DRIVER = (550, 54)
"""First NVIDIA driver of CUDA 12.4, which has conditional nodes in graphs. Without them Warp solves without an early
end: 3.8 times as slow in mujoco_warp's issue 1317."""
LEAST_DISK = 2.0
"""GB: a league of a few hours with its recordings, and compiled programs."""
EXTRAS = {
    "view": "matches in 3D", "video": "films and pictures", "foxglove": "recordings for Foxglove", "dash": "the page",
    "tensorboard": "curves for TensorBoard", "wandb": "curves for Weights & Biases", "parquet": "ratings as Parquet",
    "postgres": "stores on PostgreSQL", "s3": "blobs on S3", "onnx": "policies as ONNX files",
    "envs": "PettingZoo and Gymnasium", "robots": "ants and humanoids", "sweep": "searches by Optuna",
    "site": "the pages as a site",
}  # fmt: skip
"""Purpose of each optional dependency."""

_REQUIREMENT = re.compile(r"""([\w.-]+)(?:\[[^]]*\])?[^;]*(?:;.*extra == ["']([\w-]+)["'])?""")


class Finding(NamedTuple):
    """One line of the diagnosis."""

    check: str
    state: State  # "missing": leagues cannot run; "optional": something cannot be done; "slow": done, but slowly
    found: str
    advice: str = ""  # what to do, a command where there is one


def examine() -> Iterator[Finding]:
    """Yield the findings one by one; the graphics driver is tried, which takes a few seconds."""
    packages = _packages()
    yield packages
    yield _processor()
    if packages.state != "missing":  # these import jax, mujoco and torch
        yield from _gpus()
        yield _engine()
        yield _compiler()
    yield from _extras()
    yield _graphics()
    yield _caches()
    yield _disk()


def _packages() -> Finding:
    found = ", ".join(f"{name} {number}" for name, number in versions().items())
    if problem := displaced_package():
        return Finding("packages", "missing", problem, "a virtual environment for robot-league alone")
    if absent := _absent(""):
        return Finding("packages", "missing", f"no {', '.join(absent)}", f"pip install {' '.join(absent)}")
    return Finding("packages", "ok", found)


def _processor() -> Finding:
    from arenas.physics.cpu import cores

    found = f"{cores()} cores, {machine() / 1e9:.0f} GB of memory"
    if cores() == 1:
        return Finding("processor", "slow", found, "give the process a second core: training and rating share one")
    return Finding("processor", "ok", found)


def _gpus() -> Iterator[Finding]:
    """Yield what is known of NVIDIA GPUs, and whether JAX, Warp and torch use them."""
    rows = devices.driver_rows("name", "memory.total", "driver_version")
    if not rows:
        yield Finding("GPU", "ok", "none by NVIDIA: leagues run on the CPU, which is enough for small ones")
        return
    import jax

    names = ", ".join(f"{name} ({float(memory) / 1024:.0f} GiB)" for name, memory, _ in rows)
    usable = jax.default_backend() == "gpu" and not _absent("cuda") and devices.torch_has_cuda()
    yield (
        Finding("GPU", "ok", names)
        if usable
        else Finding("GPU", "slow", f"{names}, which JAX, Warp or torch cannot use", "pip install 'robot-league[cuda]'")
    )
    driver = rows[0][2]
    if tuple(map(int, re.findall(r"\d+", driver)[:2])) < LEAST_DRIVER:
        least = ".".join(map(str, LEAST_DRIVER))
        yield Finding(
            "GPU driver", "slow", f"{driver}, which lacks conditional nodes in CUDA graphs", f"a driver from {least} on"
        )
    else:
        yield Finding("GPU driver", "ok", driver)


def _engine() -> Finding:
    """Step a small model with the engine that leagues use here."""
    import mujoco
    import numpy as np

    from arenas.physics.registry import resolve_engine

    name = resolve_engine("auto")
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='plane' size='1 1 1'/><body pos='0 0 1'><freejoint/><geom size='.1'/></body>"
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1000)
    if not np.isfinite(data.qpos).all() or abs(data.qpos[2] - 0.1) > 0.01:
        return Finding("engine", "missing", f"{name}: a ball that falls does not come to rest on the floor")
    return Finding("engine", "ok", name)


def _compiler() -> Finding:
    if lacks := devices.lacks_to_compile():
        return Finding(
            "compiler", "optional", f"no {lacks}: learner.compile cannot be used", "apt-get install g++"
            if "C++" in lacks else "pip install triton",
        )  # fmt: skip
    return Finding("compiler", "ok", "torch.compile has what it needs")


def _extras() -> Iterator[Finding]:
    """Yield a finding for all optional dependencies that are there, and one for each that is not."""
    absent = {extra: packages for extra in EXTRAS if (packages := _absent(extra))}
    yield Finding("extras", "ok", ", ".join(extra for extra in EXTRAS if extra not in absent) or "none")
    for extra in absent:
        yield Finding(
            "extras",
            "optional",
            f"{extra}, for {EXTRAS[extra]}, is not installed",
            f"pip install 'robot-league[{extra}]'",
        )


def _graphics() -> Finding:
    """Start rerun's viewer without a window to see whether it can draw."""
    from dashboards.errors import ViewerError
    from dashboards.viewer.headless import NO_DRIVER, headless_viewer

    if _absent("view"):
        return Finding("graphics", "optional", "not tried, because rerun is not installed")
    try:
        with headless_viewer((64, 64)):
            return Finding("graphics", "ok", "rerun draws pictures without a window")
    except ViewerError as error:
        found = "no Vulkan: pictures have no panels" if str(error) == NO_DRIVER else str(error)
        return Finding("graphics", "optional", found, "apt-get install mesa-vulkan-drivers")


def _caches() -> Finding:
    folder = environment.cache_folder()
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".doctor"
        probe.touch()
        probe.unlink()
    except OSError as error:
        return Finding(
            "caches", "slow", f"{folder} cannot be written ({error.strerror}): each start compiles anew",
            "ROBOT_LEAGUE_CACHE=/a/folder",
        )  # fmt: skip
    return Finding("caches", "ok", f"{folder}, {size / 1e9:.2f} GB of compiled programs")


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    found = f"{free:.1f} GB free in {Path.cwd()}"
    if free < LEAST_DISK:
        return Finding("disk", "slow", found, f"at least {LEAST_DISK:g} GB, or --store on another disk")
    return Finding("disk", "ok", found)


def _absent(extra: str) -> list[str]:
    """Return the packages of an extra that are not installed; of "", those that are always needed."""
    absent = []
    for line in requires("robot-league") or ():
        if (found := _REQUIREMENT.match(line)) is None or (found[2] or "") != extra:
            continue
        try:
            version(found[1])
        except PackageNotFoundError:
            absent.append(found[1])
    return absent
