"""Pool of diagrams: reuse by key, and one thread while a diagram is in use."""

from types import SimpleNamespace

import pytest
import threadpoolctl

from guiderail.diagrams.envs.make import DiagramPool


def built(path="::diagram"):
    return SimpleNamespace(diagram=SimpleNamespace(diagram=SimpleNamespace(GetSystemPathname=lambda: path)))


def fail():
    raise ValueError


def num_threads():
    return {library["num_threads"] for library in threadpoolctl.threadpool_info()}


@pytest.fixture(autouse=True)
def two_threads():
    with threadpoolctl.threadpool_limits(2):
        yield


def test_acquire_returns_an_idle_diagram_of_the_key():
    pool, first, second = DiagramPool(), built(), built()
    assert pool.acquire("a", lambda: first) is first
    assert pool.acquire("a", lambda: second) is second
    pool.release("a", first)
    assert pool.acquire("b", lambda: second) is second
    assert pool.acquire("a", fail) is first


@pytest.mark.parametrize(("key", "path"), [(None, "::diagram"), ("a", "::outer::diagram")])
def test_acquire_builds_when_a_diagram_cannot_be_reused(key, path):
    pool, first, second = DiagramPool(), built(path), built()
    pool.release(key, pool.acquire(key, lambda: first))
    assert pool.acquire(key, lambda: second) is second


def test_threads_are_limited_while_a_diagram_is_in_use():
    pool = DiagramPool()
    before, first, second = num_threads(), pool.acquire("a", built), pool.acquire("a", built)
    assert num_threads() == {1}
    pool.release("a", first)
    assert num_threads() == {1}
    pool.release("a", second)
    assert num_threads() == before != {1}
    with pytest.raises(ValueError):
        pool.acquire("b", fail)
    assert num_threads() == before
