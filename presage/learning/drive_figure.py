"""Draws a model trained on a drive and its calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from presage.plotting.style import empty_figure
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.calibration import Calibration
from services.estimator.precise.learning.weights import FieldCard


def draw_learned(model: FieldModel, card: FieldCard, png: Path) -> None:
    """Draws the learned distance field and the calibration of its model into ``png``."""
    figure = empty_figure(12, 4.8)
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
    _draw_field(left, model, card.world.name)
    if card.calibration is not None:
        calibration_curve(right, card.calibration)
    figure.savefig(png, dpi=120)


def _draw_field(axes: Axes, model: FieldModel, name: str) -> None:
    field = model.field
    ny, nx = field.phi.shape
    x0, y0, h = *field.origin, field.resolution
    phi = np.where(model.seen.nodes_of(field), field.phi, np.nan) if model.seen is not None else field.phi
    extent = (x0, x0 + h * (nx - 1), y0, y0 + h * (ny - 1))
    image = axes.imshow(phi, origin="lower", extent=extent, cmap="viridis", vmin=0)
    axes.contour(x0 + h * np.arange(nx), y0 + h * np.arange(ny), field.phi, levels=[0.0], colors="#D55E00")
    axes.set(
        xlabel="x (m)",
        ylabel="y (m)",
        aspect="equal",
        title=f"{name}: learned distance (m) and its zero; white: not observed",
    )
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
