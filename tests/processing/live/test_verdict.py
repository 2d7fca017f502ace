"""The verdict on a toss says what was wrong with it, and nothing where it was good."""

from __future__ import annotations

import numpy as np

from processing.live.config import LiveConfig
from processing.live.verdict import Instants, Seen, verdict, what_is_seen
from recordings.records import RgbdFrame
from recordings.tracks import ObjectTrack

N, CONFIG = 20, LiveConfig()
GOOD = Instants(4, 9, 15)


def track(status: tuple[str, ...] = ("tracked",) * N) -> ObjectTrack:
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[[s == "lost" for s in status]] = np.nan
    return ObjectTrack(0, "d455", "object", np.arange(N), poses, status, np.tile(np.eye(6), (N, 1, 1)))  # type: ignore[arg-type]


def seen(**other: object) -> Seen:
    none = np.zeros(N, dtype=bool)
    plain = {"pixels": np.full(N, 400), "cut": none, "center_px": np.zeros((N, 2)), "blurred": none}
    return Seen(**{**plain, **other})  # type: ignore[arg-type]


def said(
    shown: Seen | None = None, of: ObjectTrack | None = None, at: Instants = GOOD, judged: bool = True,
    ambiguous: bool = False, joined: bool = True,
) -> str:  # fmt: skip
    return "; ".join(verdict(of or track(), shown or seen(), at, judged, ambiguous, joined, CONFIG))


def test_nothing_is_said_of_a_good_toss() -> None:
    assert said() == ""


def test_an_object_that_leaves_the_view_is_told_with_its_frame() -> None:
    pixels, cut = np.full(N, 400), np.zeros(N, dtype=bool)
    pixels[13:], cut[12] = 0, True
    assert "left the view in frame 12" in said(seen(pixels=pixels, cut=cut))
    assert "not seen in the last 7 frames" in said(seen(pixels=pixels))


def test_a_toss_without_rest_or_flight_is_told_only_where_the_table_is_known() -> None:
    assert "never at rest" in said(at=Instants(4, 9, None))
    assert "no free flight" in said(at=Instants())
    assert said(at=Instants(), judged=False) == ""


def test_a_twin_that_is_not_decided_a_missing_place_and_flagged_frames_are_told() -> None:
    assert "twin not decided" in said(ambiguous=True)
    assert "no place among the other tosses" in said(joined=False)
    flagged = track(("interpolated",) * 4 + ("lost",) * 2 + ("tracked",) * (N - 6))
    assert "4 frames have no sure pose and 2 none" in said(of=flagged)


def test_motion_blur_is_seen_by_gradients_that_are_missing_along_the_motion() -> None:
    rng = np.random.default_rng(0)
    texture = rng.integers(0, 255, (60, 400)).astype(np.uint8)
    smeared = np.mean([np.roll(texture, k, axis=1) for k in range(15)], axis=0).astype(np.uint8)

    def frames(of: np.ndarray) -> tuple[list[RgbdFrame], list[np.ndarray]]:
        pictures, masks = [], []
        for i in range(6):
            mask = np.zeros((60, 400), dtype=bool)
            mask[10:50, 40 + 20 * i : 120 + 20 * i] = True
            color = np.repeat(np.roll(of, 20 * i, axis=1)[..., None], 3, axis=2)
            pictures.append(RgbdFrame("d455", i, i, i, np.ascontiguousarray(color), np.ones((60, 400), np.float32)))
            masks.append(mask)
        return pictures, masks

    assert what_is_seen(*frames(texture), CONFIG).blurred.sum() == 0
    assert what_is_seen(*frames(smeared), CONFIG).blurred.sum() == 5  # all that move
    assert "blurred in 5 frames" in said(seen(blurred=np.arange(N) < 5, center_px=np.arange(2.0 * N).reshape(N, 2)))


def test_a_mask_at_the_edge_of_the_image_is_cut() -> None:
    masks = [np.zeros((40, 50), dtype=bool) for _ in range(2)]
    masks[0][10:20, 30:50] = True
    masks[1][10:20, 20:40] = True
    frame = RgbdFrame("d455", 0, 0, 0, np.zeros((40, 50, 3), np.uint8), np.ones((40, 50), np.float32))
    assert what_is_seen([frame, frame], masks, CONFIG).cut.tolist() == [True, False]
