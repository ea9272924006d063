import pytest
from pydrake.systems.framework import LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support.declarations import SignalPorts


@pytest.fixture
def system():
    return LeafSystem()


def test_signals_of_equal_name_share_a_port(system):
    signals = SignalPorts(system, {"pose": 2, "force": 1}, {"force": 1, "action": 3})
    names = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
    assert names == ["pose", "force", "action"]
    assert signals.port("action") is system.get_input_port(2)
    assert {int(t) for t in signals.tickets} == {int(system.get_input_port(i).ticket()) for i in range(3)}


def test_eval_returns_all_signals_by_name(system):
    signals = SignalPorts(system, {"pose": 2, "force": 1})
    context = system.CreateDefaultContext()
    signals.port("pose").FixValue(context, [1.0, 2.0])
    signals.port("force").FixValue(context, [3.0])
    assert {name: value.tolist() for name, value in signals.eval(context).items()} == {"pose": [1, 2], "force": [3]}


def test_signal_is_refused_when_its_sizes_differ(system):
    with pytest.raises(InputError, match="'pose' can't be of size 2 and 6"):
        SignalPorts(system, {"pose": 2}, {"pose": 6})


def test_unknown_signal_is_refused_with_the_known_names(system):
    with pytest.raises(InputError, match="'wrench', only pose, force"):
        SignalPorts(system, {"pose": 2, "force": 1}).port("wrench")
