"""What the flattening process keeps of views, without running the method."""

from __future__ import annotations

import dataclasses
import gc
from types import SimpleNamespace

import garments
import pytest

from vflatten_ros import helper, job
from vflatten_ros.core import pipeline, registration
from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.errors import NotEnoughViews

CONFIG = Config()
COARSE = dataclasses.replace(CONFIG, rotation=RotationConfig(view_fit_m=0.02))


@pytest.fixture
def calls(monkeypatch):
    """The method replaced by notes of how it was called."""
    noted = SimpleNamespace(prepared=[], given=None, folded=[], so_far=None, helper=None)

    def prepare_view(view, config):
        noted.prepared.append(view.view_id)
        return f"surface of {view.view_id}"

    def fold_in(surfaces, config, so_far):
        noted.folded.append(list(surfaces))
        return tuple(surfaces)

    def flatten_garment(views, pairs, templates, config, progress, prepared, so_far, helper):
        noted.given, noted.so_far, noted.helper = dict(prepared), so_far, helper
        return garments.example_garment()

    monkeypatch.setattr(pipeline, "prepare_view", prepare_view)
    monkeypatch.setattr(registration, "fold_in", fold_in)
    monkeypatch.setattr(pipeline, "flatten_garment", flatten_garment)
    monkeypatch.setattr(job, "serialized", lambda garment, views, item: {})
    return noted


def flatten(work, views, config):
    task = SimpleNamespace(correspondences=(), config=config, item=1)
    work.flatten(views, task, lambda stage, fraction: None)


def test_a_view_is_prepared_once_and_given_to_the_method(calls):
    first, second = garments.example_views()
    work = job.Flattening(())
    work.prepare(first, CONFIG)
    assert calls.prepared == [first.view_id]
    for _ in range(2):
        flatten(work, (first, second), CONFIG)
    assert calls.prepared == [first.view_id, second.view_id]
    assert calls.given == {v.view_id: f"surface of {v.view_id}" for v in (first, second)}


@pytest.mark.parametrize("processes, cores, helped", [(1, 2, False), (2, 1, False), (2, 2, True)])
def test_the_method_is_given_a_helper_where_a_second_process_is_of_use(
    calls, monkeypatch, processes, cores, helped
):
    monkeypatch.setattr(helper, "HelperProcess", lambda: "a helper")
    monkeypatch.setattr(helper.os, "sched_getaffinity", lambda pid: set(range(cores)))
    flatten(job.load("", processes), garments.example_views(), CONFIG)
    assert calls.helper == ("a helper" if helped else None)


def test_what_was_prepared_with_other_settings_is_not_used(calls):
    (view, _) = garments.example_views()
    work = job.Flattening(())
    work.prepare(view, COARSE)
    flatten(work, (view,), CONFIG)
    assert calls.prepared == [view.view_id] * 2


def test_views_are_folded_in_as_they_arrive_in_the_order_of_their_ids(calls):
    first, second = garments.example_views()
    names = [f"surface of {view.view_id}" for view in (first, second)]
    work = job.Flattening(())
    work.prepare(second, CONFIG)
    work.prepare(first, CONFIG)
    assert calls.folded == [names[1:], names]
    flatten(work, (first, second), CONFIG)
    assert calls.so_far == tuple(names)


def test_a_view_that_shows_nothing_is_left_to_the_method(calls, monkeypatch):
    def nothing(view, config):
        calls.prepared.append(view.view_id)
        raise NotEnoughViews("5 points on the item")

    monkeypatch.setattr(pipeline, "prepare_view", nothing)
    (view, _) = garments.example_views()
    work = job.Flattening(())
    work.prepare(view, CONFIG)
    flatten(work, (view,), CONFIG)
    assert calls.prepared == [view.view_id]  # once
    assert calls.given == {} and calls.so_far is None


def test_what_was_prepared_goes_with_its_view(calls):
    views = list(garments.example_views())
    work = job.Flattening(())
    for view in views:
        work.prepare(view, CONFIG)
    del view, views[0]
    gc.collect()
    assert len(work._prepared) == 1
