"""The record of a variant: which stages hold its tracks, shapes and masks, and what a reader must know of them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping

from processing.images import Images
from processing.pipeline import notices as say
from processing.pipeline.passes import Pass
from processing.run import Run, each
from processing.segment.background.depth_scale import posterior_sigma
from processing.stages.carry import CarryResult
from processing.stages.judge import judge
from processing.stages.lose import lose
from processing.stages.masks.segment import SegmentResult
from processing.stages.recording.every_frame import masks_in_every_frame, poses_in_every_frame
from processing.stages.recording.rig import RigResult
from processing.stages.recording.scene import SceneResult, scene_notes
from processing.stages.register import RegisterResult
from processing.store import Done, locked
from processing.variants import Variant
from recordings.notices import in_order
from recordings.results.folder import Scope, TossRecord, VariantRecord, read_track, write_variant


def write_record(
    run: Run, variant: Variant, scope: Scope, last: Pass, alone: Mapping[int, Done], scene: Done[SceneResult],
    rig: Done[RigResult], masks: Mapping[int, Done[SegmentResult]], images: Mapping[int, Images],
) -> VariantRecord:  # fmt: skip
    """variants/<name>.<scope>.json. `alone`: each toss's first pass, where there is one. A lost toss has no pose; its
    shape is said to be that of the first toss."""
    lost = {t: lose(run, t, masks[t]) for t in run.lost}
    tracks, shapes = {**last.tracks, **lost}, {**last.shapes, **dict.fromkeys(lost, last.shape)}
    scale_sigma, first = posterior_sigma(rig.result.scale_sigma, run.config.rig.scale), min(last.tracks)
    moved = posed_together(last.tracks, alone)
    on_shape = {t: alone[t] for t in moved if not isinstance(last.tracks[t].result, (RegisterResult, CarryResult))}
    held = on_shape.keys() & sharing(last.tracks)
    fits = each(
        run, on_shape, lambda t: judge(run, f"toss {t}", {t: tracks[t]}, {t: shapes[t]}, images, each_frame=True)
    )

    def of_toss(t: int) -> TossRecord:
        of_first = first, tracks[first]
        before, fit = on_shape.get(t), fits.get(t)
        poses = poses_in_every_frame(run, t, tracks[t], of_first, scale_sigma, before, t in held, fit)
        return TossRecord(t, poses.name, shapes[t].name, masks_in_every_frame(run, t, masks[t]).name)

    tosses = tuple(of_toss(t) for t in run.recorded)
    contact = {str(t): done.name for t, done in last.contact.items()}
    of_stages = [*say.of_run(run, rig, masks), *(n for done in last.contact.values() for n in say.of_contact(done))]
    of_stages += say.of_shapes(last.shapes)
    record = VariantRecord(
        name=variant.name,
        scope=scope,
        label=variant.label,
        session_name=run.session.name,
        object_name=run.session.object_name,
        calibration=run.session.calibration,
        tosses=tosses,
        shape=tosses[0].shape if scope == "all" else None,
        contact=next(iter(contact.values()), None) if scope == "all" else None,
        shared_object_frame=last.shared_frame,
        session_path=os.path.relpath(run.session.path.resolve(), run.store.results.resolve()),
        warnings=in_order((*run.warnings, *last.warnings, *of_stages)),
        notes=(f"tracker: {run.tracker}", *scene_notes(scene), *last.notes),
        extra={
            "tracker": run.tracker,
            "contact_of_toss": contact,
            "passes": list(last.passes),
            **({"rollout": last.rollout.name} if last.rollout is not None else {}),
        },
    )
    with locked(run.store.results / ".variants.lock"):
        write_variant(run.store.results, record)
    return record


def posed_together(tracks: Mapping[int, Done], alone: Mapping[int, Done]) -> list[int]:
    """Tosses whose poses are another stage's than their first pass, but for those without any."""
    moved = [t for t, done in alone.items() if t in tracks and tracks[t].key != done.key]
    return [t for t in moved if not read_track(tracks[t].folder, t).lost.all()]


def sharing(tracks: Mapping[int, Done]) -> set[int]:
    """Tosses with poses in an object frame that another one has poses in, too."""
    posed = {t: track for t, track in ((t, read_track(d.folder, t)) for t, d in tracks.items()) if not track.lost.all()}
    count = Counter(track.object_frame for track in posed.values())
    return {t for t, track in posed.items() if count[track.object_frame] > 1}
