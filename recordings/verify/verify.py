"""Is a recording what it says it is? Structure, CRCs, manifest and counts first, then what the messages say."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recordings.bounded.documents import as_dict, json_object, parse_json, read_document
from recordings.errors import BadInput, DamagedFile, TosslabError
from recordings.mcap.structure import Finding, Severity, Structure, check_structure
from recordings.progress import Progress, Silent
from recordings.session import Toss
from recordings.tracks import RigCalibration
from recordings.verify.content import check_content
from recordings.whole_file import file_sha256

ORDER: dict[Severity, int] = {"error": 0, "warning": 1, "info": 2}


@dataclass(frozen=True)
class Report:
    """Everything that verify found at `path`. `own` is False for an MCAP file that tosslab did not write."""

    path: str
    files: tuple[str, ...]
    messages: int
    bytes: int
    own: bool
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """No damage; warnings do not count."""
        return not self.errors

    @property
    def errors(self) -> tuple[Finding, ...]:
        return tuple(f for f in self.findings if f.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        return tuple(f for f in self.findings if f.severity == "warning")

    def to_json(self) -> dict[str, Any]:
        return {
            "path": self.path,
            "ok": self.ok,
            "own": self.own,
            "files": list(self.files),
            "messages": self.messages,
            "bytes": self.bytes,
            "errors": len(self.errors),
            "warnings": len(self.warnings),
            "findings": [{"severity": f.severity, "place": f.place, "text": f.text} for f in self.findings],
        }

    def to_text(self) -> str:
        lines = [f"{f.severity:<8}{f.place}: {f.text}" for f in self.findings]
        what = f"{len(self.files)} files, {self.messages} messages, {self.bytes / 1e6:.1f} MB"
        if not self.own and self.ok:
            what += "; not tosslab's own: only the MCAP structure was checked"
        verdict = "ok" if self.ok else f"DAMAGED: {len(self.errors)} errors"
        return "\n".join([*lines, f"{self.path}: {verdict}, {len(self.warnings)} warnings ({what})"])


def verify(path: Path, progress: Progress | None = None) -> Report:
    """Check a session folder or one file of any suffix. Raises BadInput when it is neither or cannot be read."""
    if not path.exists():
        raise BadInput(f"{path} does not exist; wanted a session folder or an .mcap file")
    if path.is_dir():
        return _verify_folder(path, progress or Silent())
    structure = check_structure(path)
    findings = [*structure.findings, *_check_file(path, structure)]
    return _report(path, [structure], findings)


def _report(path: Path, structures: list[Structure], findings: list[Finding]) -> Report:
    return Report(
        str(path),
        tuple(s.name for s in structures),
        sum(len(t.log_ns) for s in structures for t in s.topics.values()),
        sum(s.size for s in structures),
        bool(structures) and all(s.own for s in structures),
        tuple(sorted(findings, key=lambda f: ORDER[f.severity])),
    )


def _check_file(path: Path, structure: Structure) -> Iterator[Finding]:
    """What lies above the bytes of one file: only asked where they are whole."""
    if structure.damaged:
        return
    if not structure.own or not any(m.name == "tosslab" for m in structure.metadata):
        writer = " ".join(filter(None, (structure.profile, structure.library))) or "an unknown program"
        text = f"written by {writer}, not by tosslab: only the MCAP structure was checked"
        yield Finding("error" if structure.own else "info", structure.name, text)
        return
    yield from _check_counts(structure)
    yield from _recovered(structure)
    try:
        toss = Toss(path)
        try:
            yield from check_content(toss, structure.topics, structure.name)
        finally:
            toss.close()
    except TosslabError as wrong:
        yield Finding("error", structure.name, str(wrong))


def _check_counts(structure: Structure) -> Iterator[Finding]:
    """What the file's own stop record counted against what is there."""
    stops = [m.metadata for m in structure.metadata if m.name == "tosslab.stop"]
    if not stops:
        yield Finding("error", structure.name, "there is no stop record: writing did not end as it should")
        return
    streams = json_object(stops[-1].get("streams", ""))
    if not streams and structure.topics:
        yield Finding("error", structure.name, "its stop record cannot be read")
        return
    status = stops[-1].get("status", "")
    if status not in ("complete", "recovered"):
        yield Finding("warning", structure.name, f"was not recorded to its end: status {status!r}")
    yield from _compare_counts(structure, streams)


def _compare_counts(structure: Structure, streams: Mapping[str, Any]) -> Iterator[Finding]:
    for topic in sorted({*streams, *structure.topics}):
        counts = as_dict(streams.get(topic))
        found = len(structure.topics[topic].log_ns) if topic in structure.topics else 0
        if counts.get("written", 0) != found:
            text = f"{topic}: the stop document counts {counts.get('written', 0)} messages written, {found} are there"
            yield Finding("error", structure.name, text)
        if counts.get("dropped", 0):
            received = counts.get("received", "?")
            yield Finding(
                "warning", structure.name, f"{topic}: {counts['dropped']} of {received} messages were dropped"
            )


def _recovered(structure: Structure) -> Iterator[Finding]:
    for metadata in structure.metadata:
        if metadata.name == "tosslab.recovered":
            lost = as_dict(json_object(metadata.metadata.get("report", "")).get("lost"))
            words = ", ".join(f"{n} of {t}" for t, n in lost.items()) or "no message that could be counted"
            yield Finding(
                "warning", structure.name, f"recovered from {metadata.metadata.get('from', '?')}; lost: {words}"
            )


def _verify_folder(path: Path, progress: Progress) -> Report:
    findings: list[Finding] = []
    document: Mapping[str, Any] = {}
    recordings = sorted(path.glob("*.mcap"))
    if not recordings and not (path / "session.json").exists():
        raise BadInput(f"{path} is no session: it holds neither session.json nor an .mcap file")
    try:
        document = read_document(path / "session.json")
    except BadInput as wrong:
        findings.append(Finding("error", "session.json", str(wrong)))
    findings += _check_calibration(path)
    recordings += sorted((path / "truth").glob("*.mcap"))
    structures = []
    for i, file in enumerate(recordings):
        progress.step(i, len(recordings), file.name)
        name = file.relative_to(path).as_posix()
        try:
            structure = check_structure(file, name)
        except BadInput as wrong:
            findings.append(Finding("error", name, str(wrong)))
            continue
        structures.append(structure)
        findings += [*structure.findings, *_check_file(file, structure)]
    progress.step(len(recordings), len(recordings))
    if document:
        findings += _check_stop(path, document, {s.name: s for s in structures})
    findings += _check_truth(path, {s.name: s for s in structures})
    return _report(path, structures, findings)


def _check_calibration(path: Path) -> Iterator[Finding]:
    try:
        RigCalibration.read(path / "calibration.json")
    except TosslabError as wrong:
        yield Finding("error", "calibration.json", str(wrong))


def _check_stop(path: Path, document: Mapping[str, Any], seen: Mapping[str, Structure]) -> Iterator[Finding]:
    stop = document.get("stop")
    if not isinstance(stop, dict):
        text = "no stop document: the recording was cut off; `toss-session recover` closes it in a new folder"
        yield Finding("warning", "session.json", text)
        return
    if stop.get("status") != "complete":
        yield Finding(
            "warning", "session.json", f"status {stop.get('status')!r}: {stop.get('reason') or 'no reason given'}"
        )
    sha256 = as_dict(stop.get("sha256"))
    yield from _check_manifest(path, sha256, seen)
    for name in seen:
        if name not in sha256 and "/" not in name:
            yield Finding("warning", name, "not in the manifest of session.json: it was not finished, or came later")
    streams = as_dict(stop.get("streams"))
    for name, structure in seen.items():
        counts = streams.get(name.removesuffix(".mcap"))
        if isinstance(counts, dict) and not structure.damaged and name in sha256:
            for finding in _compare_counts(structure, counts):
                if finding.severity == "error":
                    yield Finding("error", finding.place, f"{finding.text} (session.json)")


def _check_manifest(path: Path, sha256: Mapping[str, Any], seen: Mapping[str, Structure]) -> Iterator[Finding]:
    for name, stated in sorted(sha256.items()):
        file = path / name
        if not file.is_file():
            yield Finding("error", name, "is in the manifest of session.json, but not in the folder")
            continue
        try:
            found = (seen[name].sha256 if name in seen else "") or file_sha256(file)
        except OSError as refused:
            yield Finding("error", name, f"cannot be read: {refused.strerror}")
            continue
        if found != stated and name == "calibration.json":
            yield Finding("warning", name, "was changed after the recording (its sha256 is not the manifest's)")
        elif found != stated:
            yield Finding("error", name, "its sha256 differs from the manifest's: bytes were altered after writing")


def _check_truth(path: Path, seen: Mapping[str, Structure]) -> Iterator[Finding]:
    document = path / "truth" / "truth.json"
    if not document.parent.is_dir():
        return
    try:
        sha256 = as_dict(parse_json(document.read_bytes(), "truth.json").get("sha256"))
    except (OSError, AttributeError, DamagedFile):
        yield Finding("error", "truth/truth.json", "cannot be read as a JSON object")
        return
    truth = {n.removeprefix("truth/"): s for n, s in seen.items() if n.startswith("truth/")}
    for finding in _check_manifest(path / "truth", sha256, truth):
        yield Finding(finding.severity, f"truth/{finding.place}", finding.text.replace("session.json", "truth.json"))
