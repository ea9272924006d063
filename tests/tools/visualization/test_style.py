"""Legends of figures."""

from guiderail.tools.visualization.figures import legend_above, new_figure


def test_legend_is_above_the_data():
    figure, axes = new_figure(1, 1, (4.0, 3.0))
    axis = axes[0, 0]
    axis.plot([0.0, 1.0], [0.0, 1.0], label="rising")
    axis.plot([0.0, 1.0], [1.0, 0.0], label="falling")
    legend_above(axis)
    figure.canvas.draw()
    legend, data = axis.get_legend().get_window_extent(), axis.get_window_extent()
    assert legend.y0 >= data.y1 - 3.0  # [pixel]
