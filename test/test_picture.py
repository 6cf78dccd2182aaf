"""The picture of a flattened item has everything in it, whatever the item's extent."""

import dataclasses

import garments
import numpy as np

from vflatten_ros import picture
from vflatten_ros.core.values import Outline


def count(image, colour):
    return int((image == np.array(colour)).all(axis=-1).sum())


def test_points_outline_and_sizes_are_drawn_in_their_colours():
    image = picture.draw_flat(garments.example_garment())
    assert image.dtype == np.uint8 and image.shape[2] == 3
    for colour in (picture.GREY, picture.BLUE, picture.ORANGE, picture.VERMILION, picture.GREEN):
        assert count(image, colour) > 50


def test_lengths_in_the_picture_are_to_scale():
    image = picture.draw_flat(garments.example_garment())
    rows = np.flatnonzero((image == np.array(picture.BLUE)).all(axis=-1).any(axis=1))
    drawn = (rows.max() - rows.min()) / picture.PIXELS_PER_M
    assert abs(drawn - garments.HEIGHT_M) < 0.01


def test_an_outline_far_too_large_gives_a_picture_of_bounded_size():
    garment = garments.example_garment()
    outline = garment.outline
    huge = Outline(outline.uv * 1e4, outline.sigma_m, outline.inferred)
    image = picture.draw_flat(dataclasses.replace(garment, outline=huge))
    assert max(image.shape) <= picture.MAX_SIDE_PX + 500
