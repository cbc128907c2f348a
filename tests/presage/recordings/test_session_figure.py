"""The figure of a recorded session."""

from __future__ import annotations

from array import array
from io import BytesIO

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from common.errors import UserError
from common.messages.topics import BELIEF, GOAL, HEALTH, PREDICTION, SCAN, STATUS, TOPICS, TRUTH
from presage.recordings.session_figure import draw_session, figure_of, plot_command
from presage.recordings.session_summary import load_session
from tests.recorder import sessions as made


def texts(figure):
    return " | ".join(text.get_text() for axes in figure.axes for text in axes.texts)


def labels(axes):
    legend = axes.get_legend()
    return {text.get_text() for text in legend.get_texts()} if legend else set()


def test_picture(tmp_path):
    png = tmp_path / "run.png"
    draw_session(made.write(tmp_path / "run.mcap"), png, title="a run")
    image = imread(BytesIO(png.read_bytes()))
    height, width = image.shape[:2]
    assert width == 12 * 150
    assert 0.6 < height / width < 1.0
    assert image[..., :3].std() > 0.1  # something is drawn
    for part in (image[: height // 2], image[height // 2 :, : width // 3], image[height // 2 :, -width // 3 :]):
        assert part[..., :3].std() > 0.05


def test_lines_of_panels(tmp_path):
    figure = figure_of(load_session(made.write(tmp_path / "run.mcap")), "run")
    plan, scan, energy, errors = figure.axes
    assert {"last scan", "goal and tolerance", "believed path", "true path", "true start"} <= labels(plan)
    assert labels(scan) == {"measured", "predicted", "± 2σ"}
    assert {"free energy F", "complexity"} <= labels(energy)
    assert energy.get_yscale() == "log"  # it spans decades
    assert labels(errors) == {"position error", "distance to goal", "localised", "goal reached"}
    drawn = next(line for line in errors.lines if line.get_label() == "position error")
    assert drawn.get_ydata() == pytest.approx([made.error(i) for i in range(made.SCANS)])
    away = next(line for line in errors.lines if line.get_label() == "distance to goal")
    assert away.get_ydata() == pytest.approx([8 - made.true_x(i) for i in range(made.MOVED, made.SCANS)])
    measured = next(line for line in scan.lines if line.get_label() == "measured")
    assert len(measured.get_xdata()) == made.SCANNER.beams
    assert texts(figure) == ""


def test_error_below_a_millimetre(tmp_path):
    session = load_session(made.write(tmp_path / "run.mcap"))
    session.true_poses = session.belief.poses + np.array([5e-4, 0, 0])
    errors = figure_of(session, "run").axes[-1]
    drawn = next(line for line in errors.lines if line.get_label() == "position error")
    assert drawn.get_ydata() == pytest.approx(5e-4)


@pytest.mark.parametrize(
    ("missing", "world", "expected"),
    [
        (TOPICS, False, ["world and no path", "predicted scan", "belief", "truth beside beliefs"]),
        ((TRUTH,), True, ["truth beside beliefs"]),
        ((BELIEF,), True, ["belief", "truth beside beliefs"]),
        ((PREDICTION,), True, ["predicted scan"]),
        ((SCAN,), True, ["predicted scan"]),
        ((GOAL, STATUS, HEALTH), True, []),
        ((), False, []),
    ],
    ids=["everything", "truth", "belief", "prediction", "scan", "goal", "world"],
)
def test_missing_topics(tmp_path, missing, world, expected):
    figure = figure_of(load_session(made.write(tmp_path / "part.mcap", *missing, world=world)), "part")
    png = BytesIO()
    figure.savefig(png, dpi=30)
    png.seek(0)
    assert imread(png)[..., :3].std() > 0.01
    assert texts(figure) == " | ".join(f"no {what} in this recording" for what in expected)


def test_beliefs_without_free_energy(tmp_path):
    session = load_session(made.write(tmp_path / "run.mcap"))
    session.belief._rows = array("d", [np.nan if k % 6 > 2 else v for k, v in enumerate(session.belief._rows)])
    assert texts(figure_of(session, "run")) == "no free energy in this recording"


def test_unknown_format(tmp_path):
    recording = made.write(tmp_path / "run.mcap")
    with pytest.raises(UserError, match=r"run\.txt: the name of the figure must end with \.png"):
        plot_command(recording, tmp_path / "run.txt", None, Console(quiet=True))


def test_unwritable_folder(tmp_path):
    recording = made.write(tmp_path / "run.mcap")
    with pytest.raises(UserError, match="cannot be written"):
        draw_session(recording, tmp_path / "nowhere" / "run.png")
