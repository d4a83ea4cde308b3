"""Some damaged files of every format in each run of the tests; each night 400, by ``make fuzz`` 10,000 a format.

What cannot be found out: damage that leaves a value plausible, and damage that makes a part of the log look like
something the format lets pass (a comment, other traffic in a capture, a return without an echo).
"""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import pytest

from roadscan.core.errors import RoadscanError
from roadscan.ingest.reading.format import LogSource, format_of, log_formats
from tests.fuzz.harness import Broken, Fuzzer, bounded, damaged_record, others_differ, read
from tests.fuzz.mutations import changed
from tests.fuzz.samples import Sample, all_samples

A_FORMAT = 40
A_NATIVE_FORM = 6
A_RECORDED_FORM = 40

SAMPLES = {sample.name: sample for sample in all_samples()}
FORMS = Counter(sample.format for sample in SAMPLES.values())
RECORDED = [name for name, sample in SAMPLES.items() if sample.spans]
ONE_A_FORMAT = {sample.format: sample for sample in reversed(SAMPLES.values()) if not sample.native}


def test_every_format_is_fuzzed() -> None:
    assert set(FORMS) == set(log_formats()), "give a new format a sample in tests/fuzz/samples.py"


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_damaged_files(tmp_path: Path, name: str) -> None:
    sample = SAMPLES[name]
    fuzzer = Fuzzer(sample, tmp_path)
    assert fuzzer.sound.rows > 0
    assert fuzzer.sound.rejected == (sample.format == "e57")  # one point that the scanner itself marks as invalid
    count = A_NATIVE_FORM if sample.native else -(-A_FORMAT // FORMS[sample.format])
    failed = [outcome for outcome in map(fuzzer.run, range(count)) if outcome.verdict == "failed"]
    assert [(o.number, o.said) for o in failed] == []


@pytest.mark.parametrize("name", RECORDED)
def test_damage_in_one_record_changes_no_other(tmp_path: Path, name: str) -> None:
    fuzzer = Fuzzer(SAMPLES[name], tmp_path)
    for number in range(A_RECORDED_FORM):
        rng = random.Random(f"{name} {number}")
        k, data = damaged_record(fuzzer, rng)
        assert others_differ(fuzzer, k, data) == "", f"damage {number}, record {k}"


# Surveyed lines look like lines of roads, and one file holds control and where pictures show it: the format is stated.
STATED = {"control_lines", "odm_picture_points", "opensfm_picture_points"}


@pytest.mark.parametrize("name", [name for name, one in SAMPLES.items() if one.format not in STATED])
def test_sound_files_are_of_one_format(tmp_path: Path, name: str) -> None:
    assert format_of(SAMPLES[name].make(tmp_path)).name == SAMPLES[name].format


@pytest.mark.parametrize("reader", ONE_A_FORMAT)
def test_files_of_other_formats(tmp_path: Path, reader: str) -> None:
    """A survey file may state the wrong format: the reader says so, or finds nothing but what it may yield."""
    own = ONE_A_FORMAT[reader]
    log_format = log_formats()[reader]
    for other in ONE_A_FORMAT.values():
        folder = tmp_path / other.format
        folder.mkdir()
        path = other.make(folder)
        source = LogSource(path, log_format.options.parse(own.options), **own.stated)
        try:
            with bounded():
                read(log_format, source)
        except RoadscanError as error:
            assert str(error)


# --- the fuzz itself --------------------------------------------------------------------------------


def _sample(name: str) -> Sample:
    return SAMPLES[name]


def test_the_same_numbers_give_the_same_damage(tmp_path: Path) -> None:
    one, two = Fuzzer(_sample("sbet/plain"), tmp_path / "a"), Fuzzer(_sample("sbet/plain"), tmp_path / "b")
    assert [one.damaged(k) for k in range(50)] == [two.damaged(k) for k in range(50)]
    assert len({one.damaged(k)[1] for k in range(50)}) > 40


def test_damage_reaches_what_is_packed(tmp_path: Path) -> None:
    fuzzer = Fuzzer(_sample("trajectory_csv/gz"), tmp_path)
    said = [fuzzer.run(k).said for k in range(60)]
    assert any("not a number" in text or "fields, expected" in text for text in said)  # below the packing
    assert any("compressed" in text or "no text" in text for text in said)  # the packing itself


@pytest.mark.slow
def test_what_a_reader_must_not_do_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Losing a record, a crash, a hang, too much memory: each is a failure."""
    fuzzer = Fuzzer(_sample("sbet/plain"), tmp_path)
    target, data = fuzzer.damaged(0)[0], fuzzer.content
    sbet = log_formats()["sbet"]
    sound = sbet.read

    def losing(source, header):  # type: ignore[no-untyped-def]
        for item in sound(source, header):
            yield type(item)(item.table, item.batch.slice(1))

    def crashing(source, header):  # type: ignore[no-untyped-def]
        raise IndexError("list index out of range")

    def hanging(source, header):  # type: ignore[no-untyped-def]
        while True:
            pass

    def greedy(source, header):  # type: ignore[no-untyped-def]
        b"x" * (200 << 20)
        yield from sound(source, header)

    def vast(source, header):  # type: ignore[no-untyped-def]
        bytearray(1 << 40)
        yield from sound(source, header)

    assert fuzzer.outcome(0, target, data).verdict == "clean"
    monkeypatch.setattr("tests.fuzz.harness.SLOWEST_S", 2.0)
    told = {losing: "12 records in the file, 11 rows", crashing: "IndexError", hanging: "took over", greedy: "took 2",
            vast: "MemoryError"}  # fmt: skip
    for reader, says in told.items():
        monkeypatch.setattr(type(sbet), "read", staticmethod(reader))
        outcome = fuzzer.outcome(0, target, data)
        assert outcome.verdict == "failed"
        assert says in outcome.said


def test_a_record_that_changes_others_is_found(tmp_path: Path) -> None:
    fuzzer = Fuzzer(_sample("sbet/plain"), tmp_path)
    spans = fuzzer.sample.spans
    assert spans is not None
    (first, end), (other, behind) = spans(fuzzer.content)[4], spans(fuzzer.content)[7]
    data = bytearray(fuzzer.content)
    data[other:behind] = data[first:end]
    assert "differ" in others_differ(fuzzer, 4, bytes(data)) or "rejected" in others_differ(fuzzer, 4, bytes(data))


def test_every_kind_of_damage_is_possible() -> None:
    rng = random.Random(1)
    text = [changed(b"a,b\n1,2\n", rng, text=True) for _ in range(3000)]
    assert {len(t) > 1 << 16 for t in text} == {True, False}
    assert any(b"nan" in t for t in text)
    numbers = [changed(bytes(400), rng, text=False, fields=(40,)) for _ in range(500)]
    assert sum(n[40:44] == b"\xff\xff\xff\xff" for n in numbers) > 1
    assert isinstance(Broken("x"), Exception)
