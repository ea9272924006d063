"""What every task's safety ledger writes down, and where it comes from."""

from pydrake.systems.framework import DiagramBuilder, OutputPort

from guiderail.systems.safety_ledger import SafetyLedger


def add_ledger(
    builder: DiagramBuilder,
    period: float,
    *,
    commanded_violation: OutputPort,
    measured_violation: OutputPort,
    contact_force: OutputPort,
    collision: OutputPort,
    saturation: OutputPort,
    fallback: OutputPort,
) -> OutputPort:
    """Adds the ledger of a task with a control step of `period` [s], and returns where its fields come out."""
    ledger = builder.AddNamedSystem("ledger", SafetyLedger(period, num_actuators=saturation.size()))
    recorded = {
        "commanded_violation": commanded_violation,
        "measured_violation": measured_violation,
        "contact_force": contact_force,
        "collision": collision,
        "saturation": saturation,
        "fallback": fallback,
    }
    for name, port in recorded.items():
        builder.Connect(port, ledger.get_record_input_port(name))
    return ledger.get_ledger_output_port()
