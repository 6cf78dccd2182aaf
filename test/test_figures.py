"""Figures: every one is drawn, whatever the result lacks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from garments import CALIBRATION, example_garment, example_views

from vflatten_ros import figures
from vflatten_ros.categories import load_templates
from vflatten_ros.plots_category import similarity

VIEWS = example_views()
GARMENT = example_garment(VIEWS)
TEMPLATES = load_templates()
NAMES = ["views.png", "geodesics.png", "flattening.png", "category.png", "summary.png"]


def colours_of(path):
    """How many pixels of a picture have each of the paper figures' colours."""
    image = cv2.imread(str(path))[..., ::-1].astype(int)
    wanted = {"blue": (0, 114, 178), "orange": (230, 159, 0), "vermilion": (213, 94, 0)}
    return {name: int((abs(image - rgb).max(-1) < 12).sum()) for name, rgb in wanted.items()}


def test_all_figures_are_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DPI", 60)  # quick
    paths = figures.draw_figures(GARMENT, VIEWS, tmp_path / "new", TEMPLATES)
    assert [path.name for path in paths] == NAMES
    assert min(cv2.imread(str(path)).shape[0] for path in paths) > 250
    found = {path.stem: colours_of(path) for path in paths}
    assert found["views"]["blue"] and found["views"]["orange"]  # points of either view
    assert found["views"]["vermilion"]  # letters
    assert found["geodesics"]["vermilion"] and found["geodesics"]["orange"]  # one line is flagged
    assert found["flattening"]["vermilion"]  # W and L


def test_a_slice_of_the_cloth_shows_how_well_the_axis_fits(tmp_path, monkeypatch):
    """One panel by either calibration; with the wrong sign the cloth lies elsewhere."""
    shown = []
    monkeypatch.setattr(figures, "draw_slice", lambda ax, views: shown.append(views))
    given = replace(CALIBRATION, joint_sign=-CALIBRATION.joint_sign)
    figures.draw_axis(given, VIEWS, tmp_path / "axis.png")
    before, after = shown
    assert [v.angle_rad for v in before] == [-v.angle_rad for v in VIEWS]
    assert {v.calibration for v in before} == {given}
    assert after == VIEWS
    monkeypatch.undo()
    figures.draw_axis(CALIBRATION, VIEWS, tmp_path / "axis.png")
    assert cv2.imread(str(tmp_path / "axis.png")).shape[1] > 1000


def without_everything():
    empty = replace(
        GARMENT.lines,
        nodes_hanger=np.empty((0, 5, 3)),
        view_id=np.empty(0, np.int64),
        length_m=np.empty(0),
        sigma_m=np.empty(0),
        flagged=np.empty(0, bool),
    )
    return replace(
        GARMENT, lines=empty, start_uv=None, category="unknown", scores={}, measurements=(),
        template_uv=np.empty((0, 2)), landmarks=(), correspondences=(),
    )  # fmt: skip


def many_views():
    """More views than are shown, of which lines belong to none."""
    ids = tuple(range(12))
    points = replace(GARMENT.points, view_id=np.arange(len(GARMENT.points.uv)) % 13 - 1)
    views = [replace(VIEWS[i % 2], view_id=i) for i in ids]
    lines = replace(GARMENT.lines, view_id=np.full(8, -1))
    return replace(GARMENT, view_ids=ids, points=points, lines=lines, start_uv=None), views


@pytest.mark.parametrize(
    ("garment", "views"),
    [(without_everything(), VIEWS), many_views(), (replace(GARMENT, view_ids=(2,)), VIEWS[:1])],
    ids=["nothing known", "many views", "one view"],
)
def test_figures_are_drawn_of_whatever_there_is(garment, views, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DPI", 30)  # quick
    paths = figures.draw_figures(garment, views, tmp_path, TEMPLATES)
    assert [path.name for path in paths] == NAMES


def test_at_most_four_views_are_shown_evenly_spread():
    garment, views = many_views()
    assert [view.view_id for view in figures.shown_views(garment, views)] == [0, 3, 6, 9]


def test_the_model_match_turns_the_outline_onto_the_model():
    """A turned, mirrored and scaled outline comes back onto the typical one."""
    model = next(t for t in TEMPLATES if t.category == "long_sleeve_shirt")
    typical = model.outline(np.zeros(model.dimensions))
    turn = np.array([[0.6, -0.8], [0.8, 0.6]]) @ np.diag([1.0, -1.0])
    assert similarity(1.3 * typical @ turn + 0.2, typical)(
        1.3 * typical @ turn + 0.2
    ) == pytest.approx(typical, abs=1e-9)


def test_a_view_a_hair_before_0_degrees_is_at_0_degrees():
    views = [replace(view, angle_rad=-1e-4) for view in VIEWS]
    for figure in (figures.views_figure(GARMENT, views), figures.summary_figure(GARMENT, views)):
        titles = [ax.get_title() for ax in figure.axes]
        assert any(title.endswith(" at 0°") for title in titles), titles
