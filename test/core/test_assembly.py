"""A towel that a hidden fold cuts in two: the loose piece finds its place beside the main one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from vflatten_ros.categories import load_templates
from vflatten_ros.core.assembly import assemble, undecided
from vflatten_ros.core.config import AssemblyConfig, Config
from vflatten_ros.core.contour import trace_outline
from vflatten_ros.core.values import FlatPiece, FlatPoints, FlatSurface, Flattened, GeodesicLines

WIDTH_M, LENGTH_M, CUT_M, STEP_M = 0.34, 0.60, 0.36, 0.004
TOWEL = tuple(t for t in load_templates() if t.category == "towel")


def piece(low_m: float, high_m: float, *, behind_m: float, turned_rad: float) -> FlatPiece:
    """The towel between two heights, as it hangs; its own plane turned about its lower left.

    Its ends are the towel's; along the cut cloth goes on unseen.
    """
    u, v = np.arange(0, WIDTH_M + 1e-9, STEP_M), np.arange(low_m, high_m + 1e-9, STEP_M)
    rows, cols = len(v), len(u)
    hung = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    number = np.arange(rows * cols).reshape(rows, cols)
    corners = (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    cells = np.stack([c.ravel() for c in corners], axis=1)
    side = (hung[:, 0] < 1e-6) | (hung[:, 0] > u[-1] - 1e-6)
    end = side | (hung[:, 1] < 1e-6) | (hung[:, 1] > LENGTH_M - 1e-6)
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    uv = (hung - [0.0, low_m]) @ np.array([[cos, sin], [-sin, cos]])
    xyz = np.column_stack([hung[:, 0], np.full(len(hung), behind_m), hung[:, 1] - LENGTH_M])
    some = np.arange(0, len(uv), 5)
    n = len(some)
    points = FlatPoints(
        uv=uv[some],
        xyz_hanger=xyz[some],
        view_id=np.arange(n) % 2,
        pixel=np.zeros((n, 2), dtype=np.int64),
        sigma_m=np.full(n, 0.002),
        stress=np.zeros(n),
        inferred=np.zeros(n, dtype=bool),
    )
    return FlatPiece(points, uv[some], FlatSurface(uv, xyz, end, cells))


def cut_towel() -> Flattened:
    main = piece(0.0, CUT_M, behind_m=0.0, turned_rad=0.0)
    loose = piece(CUT_M + STEP_M, LENGTH_M, behind_m=0.008, turned_rad=2.0)
    none = np.zeros(0)
    lines = GeodesicLines(np.zeros((0, 2, 3)), none.astype(np.int64), none, none, none > 0)
    outline = trace_outline(main.surface, 0.002, 0.5 * STEP_M, Config().contour)
    return Flattened(main.points, main.start_uv, lines, outline, (), (), pieces=(main, loose))


def assembled(**settings):
    config = dataclasses.replace(Config(), assembly=AssemblyConfig(**settings))
    return assemble(cut_towel(), TOWEL, config)[0]


def test_the_loose_piece_comes_to_lie_where_it_was_cut_off():
    best = assembled()
    size = best.template.measure(best.state, np.eye(best.template.dimensions))
    assert size["width"][0] == pytest.approx(WIDTH_M, abs=0.008)
    assert size["length"][0] == pytest.approx(LENGTH_M, abs=0.015)
    whole = np.ptp(best.flattened.points.uv, axis=0)
    assert whole == pytest.approx([WIDTH_M, LENGTH_M], abs=0.015)


def test_sizes_across_the_cut_carry_the_error_of_the_place():
    def deviation(best, name):
        return best.template.measure(best.state, best.placing[3:, 3:])[name][1]

    sure, best = assembled(shift_m=0.0, turn_rad=0.0), assembled(shift_m=0.02, turn_rad=0.0)
    assert deviation(sure, "length") == 0.0
    assert deviation(best, "length") == pytest.approx(0.02, rel=0.2)  # its end moves with it
    assert deviation(best, "width") < 0.01  # the main piece shows both its ends


def test_all_that_may_win_are_compared_with_their_pieces_in_the_best_places():
    alike = (*TOWEL, dataclasses.replace(TOWEL[0], category="cloth"))
    first, second = assemble(cut_towel(), alike, Config())
    assert first.chance == pytest.approx(second.chance, abs=1e-6)


def test_another_way_to_lay_it_flat_is_told_and_makes_sizes_uncertain():
    best = assembled()
    size = {name: value for name, (value, _) in measures(best).items()}
    shorter = best.state.copy()
    shorter[list(best.template.sizes).index("long_side")] -= 1.0
    other = dataclasses.replace(best, state=shorter, chance=best.chance - 1.0)
    odds = 1.0 / (1.0 + np.e)

    def deviation(assembly):
        return assembly.template.measure(assembly.state, assembly.placing[3:, 3:])["length"][1]

    torn = undecided(best, [other])
    off = size["length"] - measures(other)["length"][0]
    assert off > 0.1
    assert deviation(torn) == pytest.approx(np.hypot(deviation(best), np.sqrt(odds) * off), rel=0.2)
    assert [n.code for n in torn.flattened.notices] == ["solution_uncertain"]
    assert "27 %" in torn.flattened.notices[0].text
    sure = undecided(best, [dataclasses.replace(other, chance=best.chance - 12.0)])
    assert sure.flattened.notices == ()
    assert deviation(sure) == pytest.approx(deviation(best), abs=0.001)


def measures(assembly):
    return assembly.template.measure(assembly.state, np.zeros((assembly.template.dimensions,) * 2))
