"""Variables that libraries read at their start: ours where the user set none."""

import os

import pytest

from league.system import environment


@pytest.mark.parametrize(
    ("is_intel", "by_user", "found"),
    [(True, None, "AUTO"), (True, "AVX2", "AVX2"), (False, None, None), (False, "COMPATIBLE", "COMPATIBLE")],
)
def test_mkl_repeats_its_results_on_processors_of_intel(is_intel, by_user, found, monkeypatch):
    monkeypatch.setattr(os, "environ", {} if by_user is None else {"MKL_CBWR": by_user})
    monkeypatch.setattr(environment, "_is_intel", lambda: is_intel)
    environment.prepare()
    assert os.environ.get("MKL_CBWR") == found


def test_a_users_variables_stay_and_others_are_filled_in(monkeypatch):
    monkeypatch.setattr(os, "environ", {"OPENBLAS_NUM_THREADS": "3", "HOME": "/nobody"})
    environment.prepare()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3"
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
