"""The picture of a model that was trained on simulated scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.image import imread

from presage.learning.field_figure import draw_model
from services.estimator.precise.learning import weights
from services.estimator.shared.model_folder import SHIPPED


def test_nothing_is_cut_off(tmp_path):
    """The title is wider than a world of 4.5 m x 18 m."""
    model, _, card = weights.load(weights.path_of(SHIPPED, "corridor"))
    field = replace(model.field, phi=model.field.phi.T.copy(), origin=model.field.origin[::-1])
    draw_model(replace(model, field=field), card, tmp_path / "tall.png")
    picture = imread(tmp_path / "tall.png")
    edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    assert (edge == 1).all()
