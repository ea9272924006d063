"""The result of a run is an actor that proved itself."""

import torch

from guiderail.tools.proving import Proving


def lived(proving, outcomes, first=0):
    """Practising episodes with these outcomes, acted by actors whose one weight is the episode's number."""
    for number, success in enumerate(outcomes, first):
        actor = torch.nn.Linear(1, 1)
        torch.nn.init.constant_(actor.weight, number)
        proving.begin(actor)
        proving.finish(success)
    return proving


def proven(proving):
    return None if proving.proven is None else int(proving.proven["weight"])


def test_nothing_is_proven_before_so_many_episodes():
    assert proven(lived(Proving(3), [True, True])) is None
    assert proven(lived(Proving(3), [True, True, True])) == 0


def test_a_failure_is_charged_to_those_that_led_to_it():
    #                                  0  1  2  3  4  5: actors 3, 4 and 5 have not proven themselves
    assert proven(lived(Proving(3), [0, 1, 1, 1, 0, 0])) == 1


def test_among_equals_the_latest_counts():
    assert proven(lived(Proving(3), [1, 1, 1, 1, 1, 0])) == 2


def test_a_worse_one_does_not_replace_a_better_one():
    assert proven(lived(Proving(3), [1, 1, 1, 0, 1, 1])) == 0


def test_goes_on_as_it_would_have():
    first = lived(Proving(3), [0, 1, 1, 1, 0])
    second = Proving(3)
    second.restore(*first.state())
    for one in (first, second):
        lived(one, [1, 1, 1], first=5)
    assert proven(first) == proven(second) == 5
    assert first.state()[1] == second.state()[1]
