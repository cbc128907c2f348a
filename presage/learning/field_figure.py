"""Draws learned distance fields, and the calibration of a model trained on a drive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from presage.plotting.style import empty_figure, save_figure
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.calibration import Calibration
from services.estimator.precise.learning.weights import FieldCard


def draw_model(model: FieldModel, card: FieldCard, png: Path) -> None:
    """Draws the learned distance field into ``png``, beside the calibration of its model if the card has one."""
    if card.calibration is None:
        figure = empty_figure(9, 4.6)
        _draw_field(figure.add_subplot(), model, card.world.name)
    else:
        figure = empty_figure(12, 4.8)
        left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
        _draw_field(left, model, card.world.name)
        calibration_curve(right, card.calibration)
    save_figure(figure, png, dpi=120, bbox_inches="tight")  # else the title of a narrow world is cut off


def _draw_field(axes: Axes, model: FieldModel, name: str) -> None:
    """Draws the learned distance and its zero, with white where nothing was observed."""
    field = model.field
    ny, nx = field.phi.shape
    x0, y0, h = *field.origin, field.resolution
    phi = np.where(field.nodes_in(model.seen), field.phi, np.nan) if model.seen is not None else field.phi
    extent = (x0, x0 + h * (nx - 1), y0, y0 + h * (ny - 1))
    image = axes.imshow(phi, origin="lower", extent=extent, cmap="viridis", vmin=0)
    x, y = x0 + h * np.arange(nx), y0 + h * np.arange(ny)
    axes.contour(x, y, field.phi, levels=[0.0], colors="#D55E00", linewidths=0.8)
    title = f"{name}: learned distance (m) to the nearest surface, and its zero"
    if model.seen is not None:
        title += "\n(white: not observed)"
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=title)
    axes.figure.colorbar(image, ax=axes, shrink=0.8)


def calibration_curve(axes: Axes, calibration: Calibration) -> None:
    """Draws the share of held-out ranges below the predicted quantiles, over the probability of the quantiles."""
    predicted, observed = np.array(calibration.coverage).T
    axes.plot((0, 1), (0, 1), "--", color="#444444", linewidth=1, label="perfect calibration")
    axes.plot(predicted, observed, "o-", color="#0072B2", markersize=4, label=f"{calibration.scans} held-out scans")
    axes.set(
        xlabel="predicted probability",
        ylabel="share of ranges below that quantile",
        xlim=(0, 1),
        ylim=(0, 1),
        title=f"{calibration.log_likelihood:.2f} nats per beam",
        aspect="equal",
    )
    axes.legend(frameon=False)
