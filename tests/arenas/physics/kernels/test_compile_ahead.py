"""Kernels of a GPU are compiled into Warp's cache before they are loaded. NVRTC and libmathdx need no GPU for that."""

from pathlib import Path

import pytest
import warp

from arenas.physics.kernels import preparation

N = 4


class Gpu:
    """A GPU of compute capability 9.0, as the compiler sees it."""

    is_cuda, is_cpu, alias, arch, context = True, False, "described", 90, 1

    def get_cuda_compile_arch(self) -> int:
        return self.arch

    def get_cuda_output_format(self, preferred: str | None = None) -> str:
        return "cubin"

    def _get_cuda_arch_suffix(self, arch: int) -> str:
        return ""


def solving_kernel():
    """A kernel that solves by a matrix's Cholesky factor, in a module of its own."""

    @warp.kernel(module="unique", module_options={"enable_backward": False})
    def solve(A: warp.array2d(dtype=float), y: warp.array(dtype=float), x: warp.array(dtype=float)):
        factor = warp.tile_cholesky(warp.tile_load(A, shape=(N, N)))
        warp.tile_store(x, warp.tile_cholesky_solve(factor, warp.tile_load(y, shape=N)))

    return solve


@pytest.fixture
def gpu(monkeypatch):
    warp.init()
    if not warp._src.context.runtime.core.wp_is_mathdx_enabled():
        pytest.skip("this build of Warp has no libmathdx")
    monkeypatch.setattr(preparation, "_compilations", {})
    monkeypatch.setattr(warp.config, "optimization_level", None)  # the default: NVRTC refuses the tests' level 0
    return Gpu()


def binaries(folder: Path) -> dict[str, bytes]:
    """The compiled modules in a cache, by file name."""
    return {path.name: path.read_bytes() for path in folder.glob("wp_*/*.cubin")}


@pytest.mark.slow
def test_processes_build_the_solvers_that_kernels_link(gpu, tmp_path, monkeypatch):
    binary, one, other = (solving_kernel().module, 32), tmp_path / "one", tmp_path / "other"
    with monkeypatch.context() as patch:
        patch.setattr(warp.config, "kernel_cache_dir", str(one))
        patch.setattr(warp._src.context.runtime.core, "wp_cuda_compile_solver", lambda *_: pytest.fail("built here"))
        preparation.compile_ahead([binary], gpu)
        (compilation,) = preparation._compilations.values()
        assert compilation.exception() is None
        assert len(list((one / "lto").glob("*[0-9a-f].lto"))) == 2  # a factor, and a solve
        preparation._compilations.clear()
        preparation.compile_ahead([binary], gpu)
        assert not preparation._compilations  # it is in the cache
        patch.setattr(binary[0], "_compile", lambda *_, **__: pytest.fail("compiled again"))
        preparation._compile(binary, gpu, [])  # as if another process had compiled it meanwhile
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(other))
    preparation._compile(binary, gpu, [])
    assert len(binaries(one)) == 1
    assert binaries(one) == binaries(other)


@pytest.mark.slow
@pytest.mark.parametrize("instead", ["raise SystemExit(1)", "import time; time.sleep(1e6)"])
def test_warp_builds_a_solver_that_no_process_could_build(gpu, tmp_path, monkeypatch, instead):
    (script := tmp_path / "script.py").write_text(instead)
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(preparation.tile_solvers, "__file__", str(script))
    monkeypatch.setattr(preparation.tile_solvers, "LONGEST", 1.0)
    preparation.compile_ahead([(solving_kernel().module, 32)], gpu)
    (compilation,) = preparation._compilations.values()
    assert compilation.exception() is None
    assert len(binaries(tmp_path)) == 1
    assert len(list((tmp_path / "lto").glob("*[0-9a-f].lto"))) == 2
