"""Publisher of joint torque commands."""

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.arrays import as_whole
from guiderail.systems.support.declarations import check_period, input_getter


class TorquePublisher(LeafSystem):
    """Publish joint torques once per period while ``is_sending`` is 1; otherwise send no message, not even zero torque.

    While ``is_holding`` is 1, `hold` is called once per period instead. If it returns False, torques are published as
    if ``is_holding`` were 0.

    .. pydrake_system::

        name: TorquePublisher
        input_ports:
        - torque
        - is_sending
        - is_holding

    ``torque`` is (n,) [Nm], in the joint order of `write`. ``is_sending`` is (1,), 1 while torques are published.
    ``is_holding`` is (1,), 1 while the driver has to hold the arm.

    Args:
        write: Function that sends torques (n,) [Nm] at a time [s], such as `DriverGuard.write`.
        num_joints: Number n of joints, at least 1.
        period: Publishing period [s], positive.
        hold: Function that makes the driver hold the arm, such as `DriverGuard.hold`; returns False on failure.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(
        self,
        write: Callable[[np.ndarray, float], object],
        num_joints: int,
        *,
        period: float,
        hold: Callable[[], bool | None],
    ):
        super().__init__()
        check_period(period)
        self._write, self._hold = write, hold
        self._torque_port = self.DeclareVectorInputPort("torque", as_whole(num_joints, "num_joints", 1))
        self._is_sending_port = self.DeclareVectorInputPort("is_sending", 1)
        self._is_holding_port = self.DeclareVectorInputPort("is_holding", 1)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)

    get_torque_input_port = input_getter("torque", "torques, (n,) [Nm]")
    get_is_sending_input_port = input_getter("is_sending", "flag that torques are published, (1,)")
    get_is_holding_input_port = input_getter("is_holding", "flag that the driver has to hold the arm, (1,)")

    def _publish(self, context: Context) -> None:
        if self._is_holding_port.Eval(context)[0] > 0.0 and self._hold() is not False:
            return
        if self._is_sending_port.Eval(context)[0] > 0.0:
            self._write(self._torque_port.Eval(context), context.get_time())
