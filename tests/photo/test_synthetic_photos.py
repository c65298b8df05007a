"""Hand-made photographs show the page where their homographies say."""

from __future__ import annotations

import pytest
from synthetic_photos import view

from patchproof.base.geometry import apply_homography


@pytest.mark.parametrize("azimuth", [0.0, 40.0])
def test_the_hand_made_page_lies_where_its_homography_says(azimuth):
    # the design's center is what the camera looks at: it must fall on the middle of the picture
    homography = view(azimuth_deg=azimuth, roll_deg=10)
    center = apply_homography(homography, [[105.0, 130.0]])[0]
    assert center == pytest.approx([600.0, 450.0], abs=1e-6)
