"""Legends and curves of figures."""

import numpy as np

from guiderail.tools.visualization.figures import draw_runs, legend_above, new_figure


def test_legend_is_above_the_data():
    figure, axes = new_figure(1, 1, (4.0, 3.0))
    axis = axes[0, 0]
    axis.plot([0.0, 1.0], [0.0, 1.0], label="rising")
    axis.plot([0.0, 1.0], [1.0, 0.0], label="falling")
    legend_above(axis)
    figure.canvas.draw()
    legend, data = axis.get_legend().get_window_extent(), axis.get_window_extent()
    assert legend.y0 >= data.y1 - 3.0  # [pixel]


def test_draw_runs_draws_the_mean_and_a_band_of_runs():
    _, axes = new_figure(1, 2, (4.0, 3.0))
    runs = [np.array([0.0, 2.0, 4.0]), np.array([2.0, 2.0])]
    draw_runs(axes[0, 0], runs, color="C0", label="two", window=1)
    draw_runs(axes[0, 1], runs[:1], color="C0", label="one", window=1)
    np.testing.assert_array_equal(axes[0, 0].lines[0].get_ydata(), [1.0, 2.0])
    assert [len(axis.collections) for axis in axes.flat] == [1, 0]
