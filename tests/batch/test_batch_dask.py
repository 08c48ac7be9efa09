"""The same batch on the workers of a Dask scheduler."""

from __future__ import annotations

import sys

import pytest

from magtensor.cli import status_of


def test_without_dask_the_message_says_what_to_install(archive, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert status_of(archive.arguments(archive.survey("a.h5"), more=("--scheduler", "tcp://127.0.0.1:1"))) == 2
    assert "pip install 'magtensor[dask]'" in capsys.readouterr().err


def test_batch_on_a_cluster(archive, capsys):
    distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    surveys = [archive.survey("a.h5"), archive.survey("b.h5", "exit"), archive.survey("c.h5", "1 x2")]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        there = ("--scheduler", cluster.scheduler_address)
        assert status_of(archive.arguments(*surveys, more=there)) == 4
        assert {n: e["exit_status"] for n, e in archive.record().items()} == {"a.h5": 0, "b.h5": 1, "c.h5": 3}
        archive.forget_runs()
        assert status_of(archive.arguments(surveys[0], more=there)) == 0
        assert archive.runs() == []
    capsys.readouterr()
    assert status_of(archive.arguments(archive.survey("d.h5"), more=there)) == 2
    assert "no Dask scheduler answers there" in capsys.readouterr().err
