"""Tests of the language: what parses, what is refused and where, what prints."""

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ecatspec.model.analysis.citations import citations
from ecatspec.spec.language import overlap, overlap_search
from ecatspec.spec.language.check import check_protocol, check_words
from ecatspec.spec.language.check.texts import check_texts, unused
from ecatspec.spec.language.diagnostics import Code, SpecError
from ecatspec.spec.language.functions import FUNCTIONS
from ecatspec.spec.language.ir import (
    Access,
    After,
    Alternative,
    Anomaly,
    AnyValue,
    Area,
    Binary,
    Bool,
    Bytes,
    Call,
    Choice,
    Clause,
    Close,
    CodeRow,
    CodeTable,
    Condition,
    Conditional,
    Confirm,
    Declaration,
    Definition,
    Dictionary,
    EsiEntry,
    Example,
    Expression,
    Extend,
    Fault,
    Frame,
    FrameField,
    Gap,
    Give,
    In,
    Input,
    InputKind,
    Later,
    Level,
    Literal,
    Machine,
    Manual,
    Name,
    Named,
    ObjectEntry,
    OneOf,
    Open,
    Parameter,
    Pin,
    Protocol,
    Range,
    Reason,
    Register,
    RegisterField,
    Remove,
    Replace,
    ReplaceField,
    Risk,
    Rule,
    Send,
    SetParameter,
    Shows,
    SInt,
    SourceText,
    Store,
    Text,
    Time,
    Type,
    UInt,
    Unary,
    Update,
    Variable,
    Word,
)
from ecatspec.spec.language.load import (
    UnknownDevice,
    compile_texts,
    device_names,
    load_device,
    load_file,
    load_standard,
    plant,
)
from ecatspec.spec.language.merge import merge_standard
from ecatspec.spec.language.parse import decode, parse_text
from ecatspec.spec.language.pretty import pretty
from ecatspec.spec.language.pretty_expressions import pretty_expression
from ecatspec.spec.language.references import (
    AlternativeRef,
    ChoiceRef,
    ConstantRef,
    ParameterOfInput,
    ParameterRef,
    RegisterFieldRef,
    StateRef,
    UnresolvedName,
    VariableRef,
    WordFieldRef,
)
from ecatspec.spec.language.scope import Scope, resolve

ROOT = Path(__file__).resolve().parent.parent
BAD = ROOT / "tests" / "bad"
BASE = parse_text((BAD / "base.ecs").read_text("utf-8"), "base.ecs")
FOLDERS = ("standard", "devices", "faults")
SHIPPED = sorted(path for folder in FOLDERS for path in (ROOT / "spec" / folder).glob("*.ecs"))
MARK = b"# <-- here"


def parsed(path: Path) -> SourceText:
    return parse_text(decode(path.read_bytes(), path.name), path.name)


def compiled(source: str) -> SpecError:
    """The findings of a text on top of the base of the bad examples."""
    with pytest.raises(SpecError) as caught:
        compile_texts([BASE, parse_text(source, "text")])
    return caught.value


def codes(error: SpecError) -> list[str]:
    return [found.code.name for found in error.diagnostics]


# --- diagnostics ---------------------------------------------------------------------------------


def findings_of(path: Path) -> set[tuple[str, int]]:
    try:
        text = parsed(path)
        compile_texts([BASE, text])
        found = unused([BASE, text])
    except SpecError as error:
        found = list(error.diagnostics)
    return {(diagnostic.code.name, diagnostic.at.line) for diagnostic in found}


@pytest.mark.parametrize("code", [code.name for code in Code])
def test_bad_example_gives_its_code_where_it_says(code: str) -> None:
    path = BAD / f"{code}.ecs"
    lines = path.read_bytes().split(b"\n")
    marked = {(code, number) for number, line in enumerate(lines, 1) if MARK in line}
    assert marked
    if code.startswith("ECS5"):  # these compare with words and parameters of the whole standard
        with pytest.raises(SpecError) as caught:
            load_file(path)
        assert {(d.code.name, d.at.line) for d in caught.value.diagnostics} == marked
    else:
        assert findings_of(path) == marked


def test_every_bad_example_has_a_code() -> None:
    names = {path.stem for path in BAD.glob("*.ecs")} - {"base"}
    assert names == {code.name for code in Code}


@pytest.mark.parametrize(
    "code",
    [code.name for code in Code if code not in {Code.ECS304, Code.ECS403}],
)
def test_bad_example_gives_its_code_on_the_shipped_standard(code: str) -> None:
    with pytest.raises(SpecError) as caught:
        load_file(BAD / f"{code}.ecs")
    assert set(codes(caught.value)) == {code}


def test_a_finding_prints_place_code_sentence_and_remedy() -> None:
    with pytest.raises(SpecError) as caught:
        parse_text('standard a "b"\nparameter size : u8 := 3 [A-01]', "a.ecs")
    assert str(caught.value) == "a.ecs:2:21: ECS001 `:` is not expected here; write `=`"


def test_all_findings_of_a_phase_are_reported() -> None:
    error = compiled(
        'standard a "b"\n'
        'clause A-01 must "a" source "b"\n'
        "parameter one : u8 = nothing [A-01]\n"
        "parameter two : u8 = nowhere [A-01]\n"
    )
    assert codes(error) == ["ECS101", "ECS101"]


def test_a_nul_byte_is_no_text() -> None:
    with pytest.raises(SpecError) as caught:
        parse_text('standard a "b"\n \0', "a.ecs")
    assert codes(caught.value) == ["ECS003"]
    assert (caught.value.diagnostics[0].at.line, caught.value.diagnostics[0].at.column) == (2, 2)


def test_deep_nesting_is_a_finding_and_no_crash() -> None:
    deep = "(" * 5000 + "1" + ")" * 5000
    for depth in (deep, "-" * 5000 + "1", "not " * 5000 + "true"):
        source = f'standard a "b"\nparameter one : u8 = {depth} [A-01]'
        with contextlib.suppress(SpecError):
            parse_text(source, "a.ecs")


MACHINE = """
machine extra "a machine"
  states   al_state { INIT } initial INIT
  variable count : u8 = 0
  variable truth : bool = false
  input    event(number: u8, signed: i8, other: u8, flag: bool)
"""


def rules(*guards: str) -> str:
    """A standard text with one rule for each guard."""
    head = 'standard extra "x"\nclause X-01 must "x" source "x"\n' + MACHINE
    body = [
        f"\n  rule number_{position} [X-01]\n    from INIT on event\n    when {guard}\n"
        for position, guard in enumerate(guards)
    ]
    return head + "".join(body)


@pytest.mark.parametrize(
    ("guards", "code"),
    [
        (("number < 300",), "ECS201"),
        (("signed == -129",), "ECS201"),
        (("number in { 7..3 }",), "ECS201"),
        (("flag == 1",), "ECS202"),
        (("flag < truth",), "ECS202"),
        (("number",), "ECS202"),
        (("not number",), "ECS202"),
        (("number + flag == 1",), "ECS202"),
        (("al.state == al.code",), "ECS202"),
        (("refused_in_op == al.state",), "ECS202"),
        (("refused_in_op == go",), "ECS101"),
        (("stay == stay",), "ECS101"),
        (("nothing(number) == 1",), "ECS101"),
        (("length(number) == 1",), "ECS203"),
        (("flag", "truth"), "ECS301"),
        (("number & 3 == 1", "number & 4 == 4"), "ECS301"),
        (("number == other", "number != 3"), "ECS301"),
        (("refused_in_op == stay", "flag"), "ECS301"),
        (("flag and truth", "not flag or number == 1"), "ECS301"),
        (("not (flag and truth)", "flag or truth"), "ECS301"),
        (("flag and not flag",), "ECS302"),
        (("readable_now(1, 2) and not readable(1, 2)",), "ECS302"),
        (("number > 255",), "ECS302"),
    ],
)
def test_guard_is_refused(guards: tuple[str, ...], code: str) -> None:
    assert set(codes(compiled(rules(*guards)))) == {code}


@pytest.mark.parametrize(
    "guards",
    [
        ("flag", "not flag"),
        ("number < 7", "number == 7", "number > 7"),
        ("number in { 1, 3..5 }", "number in { 2, 6..255 }"),
        ("refused_in_op == stay", "refused_in_op == drop_to_safeop"),
        ("stay == refused_in_op", "drop_to_safeop == refused_in_op"),
        ("number == other", "number != other"),
        ("number & 3 == 1", "number & 3 == 2"),
        ("if flag then number == 1 else number == 2", "number == 3"),
        ("flag and truth", "not flag or not truth"),
        ("not (flag and truth)", "flag and truth and number == 1"),
        ("too_high(1, 2, value_of(1, 2))", "too_low(1, 2, value_of(1, 2))"),
        ("al.state == INIT", "al.state == PREOP"),
    ],
)
def test_guards_that_exclude_each_other_are_taken(guards: tuple[str, ...]) -> None:
    protocol = compile_texts([BASE, parse_text(rules(*guards), "text")])
    assert len(protocol.machines["extra"].rules) == len(guards)


@pytest.mark.parametrize(
    "guards",
    [
        ("flag and truth", "not flag or not truth"),
        ("flag or truth", "not flag and not truth"),
        ("not (flag and truth)", "flag and truth and number == 1"),
    ],
)
def test_guards_that_say_the_opposite_need_no_search(
    guards: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the names there may be more combinations than anybody looks at."""
    search, searched = overlap_search.search_samples, []

    def counted(*given: Any) -> object:  # noqa: ANN401  passed on
        searched.append(given)
        return search(*given)

    monkeypatch.setattr(overlap, "search_samples", counted)
    compile_texts([BASE, parse_text(rules("flag", "not flag"), "text")])
    plain = len(searched)
    compile_texts([BASE, parse_text(rules(*guards), "text")])
    assert len(searched) == 2 * plain


# --- which rules are compared ---------------------------------------------------------------------

LIMITS = st.dictionaries(
    st.sampled_from("abc"), st.frozensets(st.integers(0, 3), max_size=3), max_size=3
)


def have_values_left(one: overlap.Limits, other: overlap.Limits) -> bool:
    return all(one[key] & other[key] for key in one.keys() & other.keys())


@given(st.lists(LIMITS, max_size=8))
def test_rows_that_may_meet_are_those_of_all_pairs(limits: list[overlap.Limits]) -> None:
    every = itertools.combinations(range(len(limits)), 2)
    plain = {(one, other) for one, other in every if have_values_left(limits[one], limits[other])}
    assert overlap.pairs_that_may_meet(limits) == plain


GUARDS = st.recursive(
    st.sampled_from(
        [
            *(f"number == {n}" for n in range(3)),
            *(f"{n} == other" for n in range(2)),
            "number in { 0, 2 }",
            "number in { 0..1, 7 }",
            "signed == number",
            "flag",
            "not truth",
            "al.state == INIT",
            "refused_in_op == stay",
        ]
    ),
    lambda parts: (
        st.builds("({} {} {})".format, parts, st.sampled_from(["and", "or"]), parts)
        | st.builds("not ({})".format, parts)
    ),
    max_leaves=4,
)


@given(st.lists(GUARDS, min_size=2, max_size=6))
def test_what_overlaps_is_what_a_comparison_of_all_pairs_finds(guards: list[str]) -> None:
    def plain(limits: list[overlap.Limits]) -> set[tuple[int, int]]:
        every = itertools.combinations(range(len(limits)), 2)
        keys = ("input", "from")
        return {(i, j) for i, j in every if all(limits[i][k] & limits[j][k] for k in keys)}

    texts = [BASE, parse_text(rules(*guards), "text")]
    protocol, _ = merge_standard(texts)
    found = overlap.meaning(protocol)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overlap, "pairs_that_may_meet", plain)
        assert overlap.meaning(protocol) == found


def test_rules_that_constants_keep_apart_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[tuple[int, int]] = []
    monkeypatch.setattr(overlap, "_may_meet", lambda _, *pair: compared.append(pair))
    limits: list[overlap.Limits] = [{"input": {0}, "number": {n // 2}} for n in range(200)]
    overlap.pairs_that_may_meet(limits)
    assert compared == [(n, n + 1) for n in range(198, -1, -2)]


# --- risky ways ----------------------------------------------------------------------------------


def test_a_risky_way_has_a_reason_and_its_clause() -> None:
    source = (
        'standard mine "x" clause M-01 must "a" source "b"'
        ' choice pace "how fast" [BASE-01] | slow "late" | fast "early" risky "too early" [M-01]'
    )
    text = parse_text(source, "text")
    protocol = compile_texts([BASE, text])
    slow, fast = protocol.choices["pace"].alternatives
    assert (slow.risk, fast.risk) == (None, Risk("too early", ("M-01",)))
    assert protocol.risks({"pace": "fast", "refused_in_op": "stay"}) == {"pace": "too early"}
    assert protocol.risks({"pace": "slow"}) == {}
    assert '| fast  "early"  risky "too early" [M-01]' in pretty(text)
    assert parse_text(pretty(text), "text") == text
    (cited,) = (each for each in citations(protocol) if each.clauses == ("M-01",))
    assert (cited.kind, cited.name) == ("alternative", "pace.fast")
    error = compiled(source.replace('"too early" [M-01]', '"too early" [M-02]'))
    assert codes(error) == ["ECS104"]
    assert "M-02, which alternative `fast` cites" in str(error)
    with pytest.raises(SpecError) as caught:
        parse_text(source.replace('"too early" [M-01]', '"too early"'), "text")
    assert codes(caught.value) == ["ECS002"]


def test_the_standard_marks_what_the_facts_discourage() -> None:
    risky = {
        (choice.name, way.name): way.risk.clauses
        for choice in load_standard().choices.values()
        for way in choice.alternatives
        if way.risk is not None
    }
    assert risky == {
        ("emulation", "copied"): ("AL-28",),
        ("return_from_quick_stop", "served"): ("DRV-19",),
        ("reply_counter", "zero"): ("MBX-06", "MBX-20"),
        ("repeat_service", "absent"): ("MBX-04", "MBX-20"),
    }


# --- the shipped texts ---------------------------------------------------------------------------


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_text_prints_and_parses_to_the_same(path: Path) -> None:
    text = parsed(path)
    assert parse_text(pretty(text), path.name) == text
    assert path.stem in {text.name, path.stem}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_text_leaves_no_part_of_the_parser_behind(path: Path) -> None:
    kinds = {type(leaf) for leaf in leaves(parsed(path))}
    assert kinds <= {str, int, bool, bytes, type(None), Level, Access, InputKind}


def leaves(node: object) -> Iterator[object]:
    if dataclasses.is_dataclass(node):
        for field in dataclasses.fields(node):
            yield from leaves(getattr(node, field.name))
    elif isinstance(node, tuple):
        for part in node:
            yield from leaves(part)
    else:
        yield node


def test_what_a_manual_confirms_cites_it_beside_the_standard() -> None:
    text = (
        'device mine extends standard "x" clause M-01 must "a" source "b"'
        " confirm register al_control, rule al.to_init, row al_state.INIT, frame mailbox,"
        " choice refused_in_op, parameter mailbox_out [M-01]"
    )
    protocol = compile_texts([BASE, parse_text(text, "text")], "mine")
    rule = next(r for r in protocol.machines["al"].rules if r.name == "to_init")
    row = protocol.tables["al_state"].rows[0]
    named = (
        protocol.registers["al_control"],
        protocol.frames["mailbox"],
        protocol.choices["refused_in_op"],
        protocol.parameters["mailbox_out"],
    )
    assert row.clauses == ("M-01",)
    assert all(item.clauses == ("BASE-01", "M-01") for item in (rule, *named))


def test_shipped_standard_is_without_findings() -> None:
    texts = [parsed(path) for path in SHIPPED if path.parent.name == "standard"]
    assert check_texts(texts) == []
    assert check_protocol(load_standard()) == []


@pytest.mark.parametrize("name", device_names())
def test_shipped_device_is_without_findings(name: str) -> None:
    load_file(ROOT / "spec" / "devices" / f"{name}.ecs")
    assert check_protocol(load_device(name)) == []
    assert load_device(name).name == name


def test_unknown_device_names_the_nearest() -> None:
    with pytest.raises(UnknownDevice, match="did you mean `standard`"):
        load_device("standart")


def test_a_standard_file_takes_the_place_of_the_shipped_text(tmp_path: Path) -> None:
    shipped = ROOT / "spec" / "standard" / "datagram.ecs"
    changed = tmp_path / "mine.ecs"
    changed.write_text(shipped.read_text("utf-8").replace("0x88A4", "0x88A5"), "utf-8")
    before = load_standard().parameters["ether_type"].value
    after = load_file(changed).parameters["ether_type"].value
    assert before == (Literal(0x88A4),)
    assert after == (Literal(0x88A5),)
    assert load_file(changed).digest != load_standard().digest


# --- device texts --------------------------------------------------------------------------------

DEVICE = 'device mine extends standard "x"\nclause M-01 must "x" source "x" claims [AKD-001]\n'


def device(statements: str) -> SourceText:
    return parse_text(DEVICE + statements, "mine.ecs")


def test_a_device_text_pins_sets_replaces_and_removes() -> None:
    protocol = compile_texts(
        [
            BASE,
            device(
                "pin refused_in_op = stay [M-01]\n"
                "parameter preop_timeout = 200 ms [M-01]\n"
                "replace rule al.to_init [M-01]\n"
                "  set code = any\n"
                "remove rule al.init_to_preop [M-01]\n"
                "replace rule al.unknown_state_refused [M-01]\n"
                "  goto PREOP\n"
            ),
        ]
    )
    assert protocol.name == "mine"
    assert protocol.pins["refused_in_op"].alternative == "stay"
    assert protocol.parameters["preop_timeout"].value == (Literal(200_000),)
    assert protocol.parameters["preop_timeout"].clauses == ("M-01", "BASE-01")
    assert set(protocol.clauses) == {"BASE-01", "M-01"}
    first, second = protocol.machines["al"].rules
    assert first.updates == (Update("error", Literal(value=False)), Update("code", AnyValue()))
    assert first.clauses == ("M-01", "BASE-01")
    assert first.at.file == "base.ecs"
    assert second.target == "PREOP"
    assert [type(change) for change in protocol.replaced] == [Replace, Remove, Replace]


def test_a_closed_table_narrows_what_rules_set() -> None:
    text = device(
        "replace rule al.unknown_state_refused [M-01]\n"
        "  set code = one of { 0x0010..0x0020, unknown_requested_state } except 0x0012\n"
        "closed al_status_code { 0x0000, invalid_requested_state_change } [M-01]\n"
    )
    protocol = compile_texts([BASE, text], "mine")
    table = protocol.tables["al_status_code"]
    assert table.closed
    assert [row.value for row in table.rows] == [0x0000, 0x0011]
    rule = protocol.machines["al"].rules[-1]
    assert rule.updates[-1].value == OneOf((Literal(0x0011),))
    assert rule.clauses == ("M-01", "BASE-01")


@pytest.mark.parametrize(
    ("statement", "code"),
    [
        ("pin nothing = stay [M-01]", "ECS401"),
        ("pin refused_in_op = go [M-01]", "ECS401"),
        ("parameter nothing = 1 [M-01]", "ECS401"),
        ("replace rule nothing.to_init [M-01] goto INIT", "ECS401"),
        ("closed nothing { 1 } [M-01]", "ECS401"),
        ("closed al_status_code { 0x0099 } [M-01]", "ECS401"),
        ("replace rule al.to_init [M-01] goto INIT", "ECS402"),
        ("replace rule al.to_init [M-01] set error = false", "ECS402"),
        ('manual "a" "b" pin refused_in_op = stay [BASE-01]', "ECS404"),
        ("objects 0x2000 : 0 a u8 rw = 256 [M-01]", "ECS405"),
        ('objects 0x2000 : 0 a text(2) rw = "abc" [M-01]', "ECS405"),
        ("pin refused_in_op = stay [M-01] pin refused_in_op = stay [M-01]", "ECS102"),
        ('machine al "again" states al_state { INIT } initial INIT', "ECS102"),
    ],
)
def test_device_statement_is_refused(statement: str, code: str) -> None:
    with pytest.raises(SpecError) as caught:
        compile_texts([BASE, device(statement)])
    assert code in codes(caught.value)


def test_a_device_text_without_a_manual_needs_no_claims() -> None:
    statements = "pin refused_in_op = stay [BASE-01]"
    assert compile_texts([BASE, device(statements)]).pins
    bare = parse_text(f'device mine extends standard "x" {statements}', "mine.ecs")
    assert compile_texts([BASE, bare]).pins


# --- the newer constructs: what they do, and where they are refused -------------------------------

AROUND = """
frame inner in mailbox when length = 1 [X-01]
  part : u8
  rest : bytes
machine extra "a machine"
  states   al_state { INIT } initial INIT
  variable count : u8 = 0
  variable held  : bytes = zeros(0)
  input    event(number: u8)
  input    frame_came from frame mailbox
  input    happens local (number: u8)
"""
HEAD = 'standard extra "x"\nclause X-01 must "x" source "x"\n'


def of_rule(body: str, source: str = "event") -> str:
    return f"{HEAD}{AROUND}\n  rule only [X-01]\n    from INIT on {source}\n    {body}\n"


@pytest.mark.parametrize(
    ("body", "source"),
    [
        ("send inner(part = 1, rest = piece(held, 0, 0, reply.part))", "event"),
        ("send inner(part = any preferably 255) after set count = reply.part", "event"),
        ("send inner(part = 1) after give extra.event(number = reply.part)", "event"),
        ("set count = 1 send inner(part = 1) after set count = 2", "event"),
        ("send mailbox(payload = held) send inner(part = 1) after set count = reply.part", "event"),
        ("store complete 1 : 2 = any", "event"),
        ("store complete number : number = held", "happens"),
        ("deliver", "frame_came"),
        ("resend", "event"),
        ("set count = number", "happens"),
    ],
)
def test_newer_paragraph_is_taken(body: str, source: str) -> None:
    protocol = compile_texts([BASE, parse_text(of_rule(body, source), "text")])
    assert len(protocol.machines["extra"].rules) == 1


@pytest.mark.parametrize(
    ("body", "source", "code"),
    [
        # reply.FIELD means something in the send and in `after`, where the frame has the field
        ("when reply.part == 1 send inner(part = 1)", "event", "ECS101"),
        ("set count = reply.part send inner(part = 1)", "event", "ECS101"),
        ("store 1 : 2 = reply.rest send inner(part = 1)", "event", "ECS101"),
        ("send inner(part = 1) give extra.event(number = reply.part)", "event", "ECS101"),
        ("send inner(part = reply.nothing)", "event", "ECS101"),
        ("send inner(part = 1) after set count = reply.nothing", "event", "ECS101"),
        ("send inner(part = 1) after set nothing = 1", "event", "ECS101"),
        ("send inner(part = reply.part)", "event", "ECS101"),
        (
            "send inner(part = length(reply.rest), rest = piece(held, 0, 0, reply.part))",
            "event",
            "ECS101",
        ),
        ("set count = any preferably nothing", "event", "ECS101"),
        # once and for all
        ("send inner(part = 1) after set count = 1, count = 2", "event", "ECS102"),
        # after a frame, and only what can come after it
        ("after set count = 1", "event", "ECS106"),
        ("set count = 1 after give extra.event(number = 1)", "event", "ECS106"),
        ("send inner(part = 1) after resend", "event", "ECS202"),
        ("send inner(part = 1) after deliver", "frame_came", "ECS202"),
        # nothing to deliver, nobody outside who could let it happen
        ("deliver", "event", "ECS202"),
        ("deliver", "happens", "ECS202"),
        ("give extra.happens(number = 1)", "event", "ECS106"),
        # kinds and widths
        ("set count = any preferably true", "event", "ECS202"),
        ("set count = any preferably 256", "event", "ECS201"),
        ("send inner(part = any preferably 256)", "event", "ECS201"),
        ("send inner(part = 1) after set count = true", "event", "ECS202"),
        ("send inner(part = 1) after set count = 256", "event", "ECS201"),
        ("store complete true : 2 = any", "event", "ECS202"),
        ("store complete 1 : 256 = any", "event", "ECS201"),
        ("store complete 1 : 2 = 5", "event", "ECS202"),
        ("store 1 : 2 = true", "event", "ECS202"),
    ],
)
def test_newer_paragraph_is_refused(body: str, source: str, code: str) -> None:
    assert set(codes(compiled(of_rule(body, source)))) == {code}


@pytest.mark.parametrize(
    ("declaration", "code"),
    [
        ("frame other in mailbox when length = 2  part : u8 filled nothing", "ECS101"),
        ("frame other in mailbox when length = 2  part : u8 filled 256", "ECS201"),
        ("frame other in mailbox when length = 2  part : u8 filled true", "ECS202"),
        ("frame other in mailbox when length = 2  part : bytes filled 7", "ECS202"),
        ("frame other in mailbox when length = 2  part : u8 = 1 filled 2", "ECS204"),
        ("frame other in mailbox when length = 2  part : u8 filled part + 1", "ECS204"),
        ("objects 0x2000 : 0 a bytes(4) rw = 7", "ECS405"),
        ("objects 0x2000 : 0 a bytes(4) rw range 1 .. 2", "ECS405"),
        ('objects 0x2000 : 0 a bytes(2) rw = "abc"', "ECS405"),
        ("objects 0x2000 : 0 a bytes(preop_timeout) rw", "ECS405"),
        ("objects 0x2000 : 0 a bytes(true) rw", "ECS405"),
        # what changes the standard has no effect in a text of the standard
        ("pin refused_in_op = stay [X-01]", "ECS402"),
        ("open refused_in_op [X-01]", "ECS402"),
        ("replace field mailbox.length [X-01] reply 7", "ECS402"),
        ('fault wrong "x" [X-01] remove rule al.to_init [X-01]', "ECS402"),
        (
            'machine more "x" states al_state { INIT } initial INIT input a local (n: nowhere)',
            "ECS106",
        ),
    ],
)
def test_newer_declaration_is_refused(declaration: str, code: str) -> None:
    assert set(codes(compiled(HEAD + declaration))) == {code}


@pytest.mark.parametrize(
    ("statement", "code"),
    [
        ("open nothing [M-01]", "ECS401"),
        ("confirm register nothing [M-01]", "ECS401"),
        ("confirm rule al.nothing [M-01]", "ECS401"),
        ("confirm row nothing.no_error [M-01]", "ECS401"),
        ("confirm rule to_init [M-01]", "ECS401"),
        ("confirm register al_control [M-02]", "ECS104"),
        ("open refused_in_op [M-01] pin refused_in_op = stay [M-01]", "ECS402"),
        ("pin refused_in_op = stay [M-01] open refused_in_op [M-01]", "ECS402"),
        ("open refused_in_op [M-02]", "ECS104"),
        ('esi "Vendor/Id" = 1 [M-02]', "ECS104"),
        ('esi "Vendor/Id" = 1 "Vendor/Id" = 2', "ECS102"),
        ('manual "b" "c" claims M-1 .. N-2', "ECS001"),
        ('manual "b" "c" claims M-01 .. M-2', "ECS001"),
        ('manual "b" "c" claims M-2 .. M-1', "ECS001"),
        ("extend nothing variable more : u8 = 0", "ECS401"),
        ("extend al variable code : u8 = 0", "ECS102"),
        ("extend al input request()", "ECS102"),
        ("extend al rule to_init [M-01] from INIT on request when false", "ECS103"),
        ("extend al rule more [M-01] from INIT on request when requested == INIT", "ECS301"),
        ("extend al rule more from INIT on request", "ECS105"),
        ("extend al rule more [M-01] from NOWHERE on request", "ECS106"),
        ("extend al variable more : u8 = true", "ECS202"),
        ("replace field nothing.length [M-01] reply 1", "ECS401"),
        ("replace field mailbox.nothing [M-01] reply 1", "ECS401"),
        ("replace field mailbox.length [M-01] reply true", "ECS202"),
        ("replace field mailbox.length [M-01] reply 70000", "ECS201"),
        ("replace field mailbox.length [M-01] reply 7 into al.nothing", "ECS101"),
        ("replace field mailbox.length [M-01] reply 7 " * 2, "ECS102"),
        ('fault wrong "x" [M-01] remove rule al.to_init [M-01]', "ECS402"),
    ],
)
def test_newer_device_statement_is_refused(statement: str, code: str) -> None:
    with pytest.raises(SpecError) as caught:
        compile_texts([BASE, device(statement)])
    assert set(codes(caught.value)) == {code}


def test_a_field_that_stays_as_it_is_changes_nothing() -> None:
    frame = "frame other in mailbox when length = 2 [X-01]  part : u8 reply 7"
    with pytest.raises(SpecError) as caught:
        compile_texts(
            [
                BASE,
                parse_text(HEAD + frame, "text"),
                device("replace field other.part [M-01] reply 7"),
            ]
        )
    assert codes(caught.value) == ["ECS402"]


def test_a_device_text_extends_a_machine_and_replaces_a_field() -> None:
    text = device(
        "extend al\n"
        "  variable more : u8 = 0\n"
        "  input    happens local (number: u8)\n"
        "  rule counted [M-01] from INIT on happens set more = number\n"
        "  gap silence [M-01] from PREOP on happens\n"
        "replace field mailbox.length [M-01] reply any preferably 7 into al.more\n"
    )
    protocol = compile_texts([BASE, text])
    machine = protocol.machines["al"]
    assert [variable.name for variable in machine.variables] == ["error", "code", "more"]
    assert machine.inputs[-1] == Input("happens", InputKind.LOCAL, (), (("number", UInt(8)),))
    assert machine.rules[-1].name == "counted"
    assert [gap.name for gap in machine.gaps] == ["silence"]
    field = protocol.frames["mailbox"].fields[0]
    assert (field.reply, field.into) == (AnyValue(Literal(7)), "al.more")
    assert protocol.frames["mailbox"].clauses == ("M-01", "BASE-01")
    assert [type(change) for change in protocol.replaced] == [Extend, ReplaceField]


# --- words, edges, what comes later, reasons, times -----------------------------------------------

DRIVE = """
word control in 0x2040 : 0 size 2 [X-01]
  bits 0     enable : bool
  bits 4..7  mode   : u4
  bits 8..11 wanted : al_state
word status in 0x2041 : 0 size 2
  bits 0    on      : bool shows drive.count > 0 [X-01]
  bits 1..4 state   : u4   shows any when control.enable
word layout size 1
  bits 0..7 all : u8
parameter shortest : time = 1 ms [X-01]
machine drive "a machine"
  states   al_state { INIT } initial INIT
  variable count : u8 = 0
  variable held  : bytes = zeros(0)
  input    set_control from word control
  input    image_came  from outputs
  input    event(number: u8)
  input    written     from write al_control
  input    happens local (number: u8)
  input    acts    own (truth: bool)
"""


def drive(body: str, source: str = "set_control", more: str = "") -> str:
    return f"{HEAD}{DRIVE}\n  rule only [X-01]\n    from INIT on {source}\n    {body}\n{more}"


@pytest.mark.parametrize(
    ("body", "source"),
    [
        ("when rises(enable) and mode == 3 set count = mode", "set_control"),
        ("when falls(enable) and not cyclic and wanted == PREOP", "set_control"),
        ("when rises(acknowledge) or falls(identification)", "written"),
        ("when control.enable and control.wanted != INIT set count = control.mode", "event"),
        ("when layout.all == 3 and status.on", "event"),
        ("take image", "image_came"),
        ("store 1 : 2 = image take cut(image, 2) give drive.event(number = 1)", "image_came"),
        ("later drive.event(number = 1) within preop_timeout", "set_control"),
        ("later drive.happens(number = mode) after shortest within preop_timeout", "set_control"),
        (
            """take held give drive.event(number = 1)
            later drive.acts(truth = enable) within shortest
            later drive.event(number = 1) after shortest within preop_timeout within shortest""",
            "set_control",
        ),
        ("set count = 1", "acts"),
        ("within preop_timeout + microseconds(number * 1000) + shortest", "event"),
        ("when preop_timeout + shortest < microseconds(number)", "event"),
        ("when number_of(1, 2) == INIT or number_of(1, 2) > -5", "event"),
        ("when number_of(1, 2) == number or number < number_of(number, 0)", "event"),
        ("when number(held) in { 1, 3..5 } and mapped(1, 2, number) and is_mapping(1)", "event"),
        ("when can_hold(1, 2, held) and image_size(1) == pdo_bits(1, 2)", "event"),
        ("set held = assigned_pdos(1)", "event"),
        ("when 10 / number == 1 or 10 % count == 2", "event"),
    ],
)
def test_paragraph_of_process_data_is_taken_and_printed(body: str, source: str) -> None:
    text = parse_text(drive(body, source), "text")
    assert parse_text(pretty(text), "text") == text
    assert len(compile_texts([BASE, text]).machines["drive"].rules) == 1


@pytest.mark.parametrize(
    ("body", "source", "code"),
    [
        ("when rises(number)", "event", "ECS203"),
        ("when rises(mode)", "set_control", "ECS203"),
        ("when rises()", "set_control", "ECS203"),
        ("when rises(nothing)", "set_control", "ECS101"),
        ("when rises(truth)", "acts", "ECS205"),
        ("when falls(cyclic)", "set_control", "ECS205"),
        ("when falls(control.enable)", "set_control", "ECS205"),
        ("when falls(set_control.enable)", "set_control", "ECS205"),
        ("when falls(not enable)", "set_control", "ECS205"),
        ("when rises(acknowledge and identification)", "written", "ECS205"),
        ("when edge", "event", "ECS101"),
        ("when control.nothing", "event", "ECS101"),
        ("when cyclic", "event", "ECS101"),
        ("when control.enable == 1", "event", "ECS202"),
        ("when control.mode == 16", "event", "ECS201"),
        ("take 7", "image_came", "ECS202"),
        ("take image", "event", "ECS101"),
        ("deliver", "image_came", "ECS202"),
        ("deliver", "set_control", "ECS202"),
        ("give drive.acts(truth = true)", "event", "ECS106"),
        ("later drive.nothing within shortest", "event", "ECS106"),
        ("later drive.set_control within shortest", "event", "ECS106"),
        ("later nothing within shortest", "event", "ECS106"),
        ("later drive.event within shortest", "event", "ECS203"),
        ("later drive.event(nothing = 1, number = 1) within shortest", "event", "ECS101"),
        ("later drive.event(number = 256) within shortest", "event", "ECS201"),
        ("later drive.event(number = 1) within 5", "event", "ECS202"),
        ("later drive.event(number = 1) after true within shortest", "event", "ECS202"),
        ("later drive.event(number = 1)", "event", "ECS002"),
        ("within shortest + 1", "event", "ECS202"),
        ("within 1 + shortest", "event", "ECS202"),
        ("within shortest - shortest", "event", "ECS202"),
        ("within number", "event", "ECS202"),
        ("when shortest == 1", "event", "ECS202"),
        ("when 10 / 0 == number", "event", "ECS207"),
        ("when number % (2 - 2) == 1", "event", "ECS207"),
        ("set count = number / (1 / 2)", "event", "ECS207"),
        ("set count = shortest + shortest", "event", "ECS202"),
        # what an edge leads to
        ("when rises(enable) and not enable", "set_control", "ECS302"),
        ("when falls(enable) and enable", "set_control", "ECS302"),
        ("when rises(enable) and falls(enable)", "set_control", "ECS302"),
    ],
)
def test_paragraph_of_process_data_is_refused(body: str, source: str, code: str) -> None:
    more = "" if code == "ECS002" else 'define edge "a definition" = rises(enable) [X-01]'
    assert set(codes(compiled(drive(body, source, more)))) == {code}


@pytest.mark.parametrize(
    ("first", "second", "overlap"),
    [
        ("rises(enable)", "falls(enable)", False),
        ("rises(enable)", "not enable", False),
        ("falls(enable)", "enable", False),
        ("rises(enable)", "enable and not rises(enable)", False),
        ("rises(enable)", "enable", True),
        ("not rises(enable)", "not falls(enable)", True),
        ("control.enable", "not control.enable", False),
        ("control.mode < 3", "control.mode >= 2", True),
        ("preop_timeout + shortest < shortest", "not (preop_timeout + shortest < shortest)", False),
        ("shortest < preop_timeout", "mode == 3", True),
    ],
)
def test_edges_exclude_each_other(first: str, second: str, overlap: bool) -> None:  # noqa: FBT001
    other = f"rule other [X-01] from INIT on set_control when {second}"
    text = parse_text(drive(f"when {first}", more=other), "text")
    if overlap:
        with pytest.raises(SpecError, match="ECS301"):
            compile_texts([BASE, text])
    else:
        compile_texts([BASE, text])


@pytest.mark.parametrize(
    ("declaration", "code"),
    [
        ("word control size 1", "ECS102"),
        ("word other in 0x2040 : 0 size 2", "ECS102"),
        ("word other size 1 bits 0 a : bool bits 1 a : bool", "ECS102"),
        ("word other size 1 bits 0 cyclic : bool", "ECS102"),
        ("word other size 1 [NO-01]", "ECS104"),
        ("word other size 1 bits 0 a : bool [NO-01]", "ECS104"),
        ("word other size 1 bits 0..2 a : nothing", "ECS106"),
        ("word other size 1 bits 0..8 a : u9", "ECS201"),
        ("word other size 1 bits 0..1 a : u3", "ECS201"),
        ("word other size 1 bits 0..1 a : u2 bits 1 b : bool", "ECS201"),
        ("word other in 0x10000 : 0 size 1", "ECS201"),
        ("word other in 1 : 256 size 1", "ECS201"),
        ("word other size 1 bits 0 a : bool shows nothing", "ECS101"),
        ("word other size 1 bits 0 a : bool shows 1", "ECS202"),
        ("word other size 1 bits 0 a : bool shows true when 1", "ECS202"),
        ("extend drive input more from word layout", "ECS106"),
        ("extend drive input more from word nothing", "ECS106"),
        ('reason a of drive.only "x" when true [NO-01]', "ECS104"),
        ('reason a of nothing.only "x" when true [X-01]', "ECS106"),
        ('reason a of drive.nothing "x" when true [X-01]', "ECS106"),
        ('reason a of drive.only "x" when true [X-01] ' * 2, "ECS102"),
        ('reason a of drive.only "x" when 1 [X-01]', "ECS202"),
        ('reason a of drive.only "x" when enable [X-01]', "ECS101"),
        ('reason a of drive.only "{}" (mode) when true [X-01]', "ECS101"),
        ('reason a of drive.only "x" when rises(enable) [X-01]', "ECS101"),
        ('reason a of drive.only "{}" when true [X-01]', "ECS206"),
        ('reason a of drive.only "x" (1) when true [X-01]', "ECS206"),
        ('reason a of drive.only "{} {hex}" (1) when true [X-01]', "ECS206"),
        ('reason a of drive.only "{octal}" (1) when true [X-01]', "ECS206"),
        ('reason a of drive.only "{words}" (1) when true [X-01]', "ECS206"),
        ('reason a of drive.only "{}" (held) when true [X-01]', "ECS206"),
        ('reason a of drive.only "{}" (shortest) when true [X-01]', "ECS206"),
        ("extend nothing variable more : u8 = 0", "ECS401"),
        ("extend drive variable count : u8 = 0", "ECS102"),
        ("extend drive rule only [X-01] from INIT on event", "ECS103"),
    ],
)
def test_word_or_reason_is_refused(declaration: str, code: str) -> None:
    assert set(codes(compiled(drive("when enable", more=declaration)))) == {code}


REASONS = (
    'reason low of drive.only "{} is below {hex}" (count, 0x10 + control.mode) '
    "when count < 3 and al.state == PREOP [X-01]\n"
    'reason odd of drive.only "{} {} {} {words}" (control.enable, state, refused_in_op, held) '
    "when refused_in_op == stay [X-01]\n"
)


def test_what_words_and_reasons_say() -> None:
    text = parse_text(drive("when rises(enable)", more=REASONS), "text")
    assert parse_text(pretty(text), "text") == text
    protocol = compile_texts([BASE, text])
    assert [word.key for word in protocol.words.values()] == [(0x2040, 0), (0x2041, 0), None]
    assert resolve(protocol, "control.enable", Scope()) == WordFieldRef("control", "enable")
    scope = Scope("drive", "set_control")
    assert resolve(protocol, "cyclic", scope) == ParameterOfInput("cyclic")
    assert resolve(protocol, "set_control.mode", scope) == ParameterOfInput("mode")
    assert resolve(protocol, "image", Scope("drive", "image_came")) == ParameterOfInput("image")
    kinds = {item.name: (item.kind, item.origin) for item in protocol.machines["drive"].inputs}
    assert kinds["set_control"] == ("word", ("control",))
    assert kinds["image_came"] == ("outputs", ())
    assert kinds["acts"] == ("own", ())
    low, odd = protocol.reasons.values()
    assert (low.machine, low.rule, len(low.values)) == ("drive", "only", 2)
    assert odd.values[-1] == Name("held")


def test_what_words_laters_and_reasons_name_is_used() -> None:
    head = 'standard extra "x" ' + "".join(
        f'clause X-0{n} must "x" source "x" define used_{n} "x" = {value} [X-01] '
        for n, value in enumerate(["true", "zeros(1)", "1", "shortest", "true", "2"], 1)
    )
    body = (
        "when used_1 take used_2 later drive.event(number = used_3) within used_4 "
        'reason a of drive.only "{}" (used_6) when used_5 [X-02] '
        "word other size 1 [X-03] bits 0 a : bool [X-04]"
    )
    source = drive(body).replace(HEAD, head)
    assert [found.message for found in unused([BASE, parse_text(source, "text")])] == [
        "nothing uses clause X-05",
        "nothing uses clause X-06",
    ]


def test_a_text_of_the_standard_extends_a_machine_of_another() -> None:
    one = parse_text(
        HEAD + "extend al variable more : u8 = 0 input happens local () "
        "rule more [X-01] from INIT on happens set more = 1",
        "one",
    )
    two = parse_text('standard two "x" extend al variable most : u8 = 0', "two")
    protocol = compile_texts([one, two, BASE])
    machine = protocol.machines["al"]
    assert [variable.name for variable in machine.variables] == ["error", "code", "more", "most"]
    assert machine.rules[-1].name == "more"
    assert protocol.replaced == ()
    again = parse_text('standard two "x" extend al extend al', "two")
    for texts, code in (([BASE, again], "ECS102"), ([BASE, faults("extend al")], "ECS402")):
        with pytest.raises(SpecError, match=code):
            compile_texts(texts)


def of_device(statements: str) -> Protocol:
    text = parse_text(drive("when rises(enable)", more=REASONS), "text")
    return compile_texts([BASE, text, device(statements)])


def test_a_device_text_declares_words_and_reasons() -> None:
    protocol = of_device(
        "word control in 0x2040 : 0 size 4 bits 0 enable : bool bits 4..7 mode : u4"
        " bits 8..11 wanted : al_state bits 31 own : bool "
        "word latch in 0x2050 : 1 size 2 bits 0 first : bool [M-01] "
        'reason mine of drive.only "{}" (latch.first) when control.own [M-01]'
    )
    assert protocol.words["control"].size == 4
    assert list(protocol.words) == ["control", "status", "layout", "latch"]
    assert list(protocol.reasons) == ["low", "odd", "mine"]


@pytest.mark.parametrize(
    ("statement", "code"),
    [
        (DRIVE.split("word status", maxsplit=1)[0].replace("X-01", "M-01"), "ECS402"),
        ("word other in 0x2041 : 0 size 2", "ECS102"),
        ("word control in 0x2040 : 0 size 2", "ECS101"),
        ('reason low of drive.only "x" when true [M-01]', "ECS102"),
        ('remove rule drive.only [M-01] reason a of drive.only "x" when true [M-01]', "ECS106"),
    ],
)
def test_word_or_reason_of_a_device_is_refused(statement: str, code: str) -> None:
    with pytest.raises(SpecError) as caught:
        of_device(statement)
    assert set(codes(caught.value)) == {code}


def test_a_reason_goes_with_its_rule() -> None:
    assert of_device("remove rule drive.only [M-01]").reasons == {}
    text = parse_text(drive("when rises(enable)", more=REASONS), "text")
    wrong = faults('fault one "x" [BASE-01] remove rule drive.only [BASE-01]')
    protocol = compile_texts([BASE, text, wrong])
    (fault,) = wrong.declarations
    assert isinstance(fault, Fault)
    assert list(protocol.reasons) == ["low", "odd"]
    assert plant(protocol, fault).reasons == {}


def test_given_paragraphs_replace_what_a_rule_gives() -> None:
    body = "give drive.event(number = 1) later drive.event(number = 2) within shortest"
    given = "give drive.event(number = 3) give drive.event(number = 4)"
    later = "later drive.acts(truth = true) after shortest within preop_timeout"
    standard = parse_text(drive(body), "text")
    for statement, gives, laters in ((given, [3, 4], [2]), (later, [1], [True])):
        change = device(f"replace rule drive.only [M-01] {statement}")
        assert parse_text(pretty(change), "text") == change
        (rule,) = compile_texts([BASE, standard, change]).machines["drive"].rules
        arguments = [dict(give.arguments)["number"] for give in rule.gives]
        assert arguments == [Literal(number) for number in gives]
        assert [later.arguments[0][1] for later in rule.laters] == [Literal(v) for v in laters]
    same = device(f"replace rule drive.only [M-01] {body}")
    with pytest.raises(SpecError, match="ECS402"):
        compile_texts([BASE, standard, same])


def test_a_closed_table_narrows_what_comes_later() -> None:
    extra = HEAD + (
        "extend al input tell(code: al_status_code) "
        "rule told [X-01] from INIT on tell set error = true "
        "later al.tell(code = one of { 0x0011, 0x0012 }) within preop_timeout"
    )
    closed = device("closed al_status_code { 0x0000, 0x0012 } [M-01]")
    protocol = compile_texts([BASE, parse_text(extra, "text"), closed])
    (later,) = protocol.machines["al"].rules[-1].laters
    assert later.arguments == (("code", OneOf((Literal(0x0012),))),)


def test_an_object_can_be_mappable() -> None:
    source = HEAD + "objects 0x2000 : 0 a u8 rw volatile mappable 0x2001 : 0 b u8 rw"
    first, second = compile_texts([BASE, parse_text(source, "text")]).objects
    assert (first.mappable, first.volatile, second.mappable) == (True, True, False)


# --- planted faults -------------------------------------------------------------------------------


def faults(statements: str) -> SourceText:
    return parse_text(f'faults wrong "x" {statements}', "wrong.ecs")


@pytest.mark.parametrize(
    ("statement", "code"),
    [
        ('fault one "x" [NO-01] quirk any_quirk', "ECS104"),
        ('fault one "x" [BASE-01] remove rule al.to_init [NO-01]', "ECS104"),
        ('fault one "x" [BASE-01] extend al rule more from INIT on request', "ECS105"),
        ('fault one "x" [BASE-01] remove rule al.nothing [BASE-01]', "ECS401"),
        ('fault one "x" [BASE-01] extend nothing', "ECS401"),
        ('fault one "x" [BASE-01] replace field mailbox.no [BASE-01] reply 1', "ECS401"),
        ('fault one "x" [BASE-01] replace rule al.to_init [BASE-01] goto INIT', "ECS402"),
        ('fault one "x" [BASE-01]', "ECS402"),
        ('fault one "x" [BASE-01] replace rule al.to_init [BASE-01] set code = true', "ECS202"),
        ('fault one "x" [BASE-01] replace rule al.to_init [BASE-01] goto NOWHERE', "ECS106"),
        ('fault one "x" [BASE-01] quirk a fault one "x" [BASE-01] quirk b', "ECS102"),
    ],
)
def test_fault_is_refused(statement: str, code: str) -> None:
    with pytest.raises(SpecError) as caught:
        compile_texts([BASE, faults(statement)])
    assert set(codes(caught.value)) == {code}


def test_a_fault_is_planted_and_leaves_the_protocol_alone() -> None:
    text = faults('fault one "x" [BASE-01] quirk odd remove rule al.to_init [BASE-01]')
    protocol = compile_texts([BASE, text])
    (fault,) = text.declarations
    assert isinstance(fault, Fault)
    assert (fault.quirk, fault.clauses) == ("odd", ("BASE-01",))
    faulty = plant(protocol, fault)
    assert {rule.name for rule in protocol.machines["al"].rules} - {
        rule.name for rule in faulty.machines["al"].rules
    } == {"to_init"}


def test_a_fault_that_does_not_fit_is_not_planted() -> None:
    (fault,) = faults('fault one "x" [BASE-01] remove rule al.no [BASE-01]').declarations
    assert isinstance(fault, Fault)
    with pytest.raises(SpecError, match="ECS401"):
        plant(compile_texts([BASE]), fault)


@pytest.mark.parametrize(
    "path", [path for path in SHIPPED if path.parent.name == "faults"], ids=lambda path: path.name
)
def test_shipped_faults_are_without_findings(path: Path) -> None:
    device = {"edges": "kollmorgen-s300"}.get(path.stem, path.stem.replace("_", "-"))
    standard = load_device(device) if device in device_names() else load_standard()
    text = parsed(path)
    assert text.faults
    found = [f for f in check_texts([text]) if f.code is not Code.ECS104]
    assert found == []
    for fault in text.declarations:
        assert isinstance(fault, Fault)
        assert set(fault.clauses) <= set(standard.clauses)
        assert check_words(plant(standard, fault)) == []


# --- names ---------------------------------------------------------------------------------------


def test_what_names_stand_for() -> None:
    protocol = compile_texts([BASE])
    scope = Scope("al", "request")
    assert resolve(protocol, "requested", scope) == ParameterOfInput("requested")
    assert resolve(protocol, "request.requested", scope) == ParameterOfInput("requested")
    assert resolve(protocol, "error", scope) == VariableRef("al", "error")
    assert resolve(protocol, "al.error", Scope()) == VariableRef("al", "error")
    assert resolve(protocol, "state", scope) == StateRef("al")
    assert resolve(protocol, "al.state", Scope()) == StateRef("al")
    assert resolve(protocol, "al_control.acknowledge", Scope()) == RegisterFieldRef(
        "al_control", "acknowledge"
    )
    assert resolve(protocol, "mailbox_out.length", scope) == ParameterRef("mailbox_out", "length")
    assert resolve(protocol, "refused_in_op", scope) == ChoiceRef("refused_in_op")
    assert resolve(protocol, "stay", scope, ChoiceRef("refused_in_op")) == AlternativeRef(
        "refused_in_op", "stay"
    )
    assert resolve(protocol, "PREOP", scope) == ConstantRef(2, "al_state")
    assert resolve(protocol, "al_state.OP", scope) == ConstantRef(8, "al_state")
    for name in ("stay", "nothing", "al.nothing", "al_state.nothing"):
        with pytest.raises(UnresolvedName):
            resolve(protocol, name, scope)


# --- parse and print -----------------------------------------------------------------------------

names = st.sampled_from(["alpha", "b2", "long_name_of_a_thing", "NAME", "u8x", "kay-d"])
paths = st.lists(names, min_size=1, max_size=2).map(".".join)
ids = st.sampled_from(["AL-01", "AKD-120", "A-1-B", "X9-0"])
some_ids = st.lists(ids, max_size=3).map(tuple)
one_id = st.lists(ids, min_size=1, max_size=3).map(tuple)
words = st.text(st.characters(blacklist_characters='"\n\r\0', blacklist_categories=["Cs"]))
numbers = st.integers(0, 2**32)
small = st.integers(1, 64)
literals = st.booleans() | numbers
atoms: st.SearchStrategy[Expression] = (
    st.builds(Literal, literals, st.integers(0, 8)).filter(
        lambda e: not (isinstance(e.value, bool) and e.digits)
    )
    | st.builds(Name, paths)
    | st.builds(AnyValue)
)


WORDS = ("or", "and", "==", "!=", "<=", ">=")


def larger(inner: st.SearchStrategy[Expression]) -> st.SearchStrategy[Expression]:
    items = st.lists(inner | st.builds(Range, inner, inner), min_size=1, max_size=3).map(tuple)
    operators = [*WORDS, *"<>+-*/%&|"]
    return (
        st.builds(Unary, st.sampled_from(["not", "-"]), inner)
        | st.builds(Binary, st.sampled_from(operators), inner, inner)
        | st.builds(In, inner, items | st.just(()))
        | st.builds(Conditional, inner, inner, inner)
        | st.builds(Call, paths, st.lists(inner, max_size=3).map(tuple))
        | st.builds(OneOf, items, st.none() | inner)
        | st.builds(AnyValue, inner)
    )


expressions = st.recursive(atoms, larger, max_leaves=12)
short = st.recursive(atoms, larger, max_leaves=3)
optional = st.none() | short


T = TypeVar("T")


def many(strategy: st.SearchStrategy[T], least: int = 0) -> st.SearchStrategy[tuple[T, ...]]:
    return st.lists(strategy, min_size=least, max_size=3).map(tuple)


plain_types: st.SearchStrategy[Type] = (
    st.builds(UInt, small) | st.builds(SInt, small) | st.builds(Bool)
)
types: st.SearchStrategy[Type] = (
    plain_types
    | st.builds(Named, names)
    | st.builds(Bytes, optional)
    | st.builds(Text, small)
    | st.builds(Area)
    | st.builds(Time)
)
bindings = st.tuples(names, short)
updates = many(st.builds(Update, paths, short))
sends = many(st.builds(Send, names, many(bindings)))
values = many(short, 1).map(lambda parts: parts[:2])
gives = many(
    st.builds(Give, paths, many(bindings)) | st.sampled_from([Give("deliver"), Give("resend")])
)
laters = many(st.builds(Later, paths, many(bindings), optional, short))
rule = st.builds(
    Rule,
    names,
    some_ids,
    many(names, 1),
    names,
    st.none() | expressions,
    st.none() | names,
    updates,
    many(st.builds(Store, short, short, short, st.booleans())),
    sends,
    gives,
    optional,
    st.none() | st.builds(After, updates, gives),
    optional,
    laters,
)
gap = st.builds(Gap, names, some_ids, many(names, 1), names, optional)
inputs = st.builds(
    Input, names, st.sampled_from(["write", "frame"]), many(names, 1), st.just(())
) | st.builds(
    Input,
    names,
    st.sampled_from(["event", "local", "own"]),
    st.just(()),
    many(st.tuples(names, types)),
)
inputs |= st.builds(Input, names, st.just("word"), st.tuples(names))
inputs |= st.builds(Input, names, st.just("outputs"), st.just(()))
variables = many(st.builds(Variable, names, types, short))
changes = (
    st.builds(
        Replace,
        names,
        names,
        one_id,
        optional,
        st.none() | names,
        updates,
        sends,
        optional,
        gives,
        laters,
    )
    | st.builds(Remove, names, names, one_id)
    | st.builds(Extend, names, variables, many(inputs), many(rule), many(gap))
    | st.builds(ReplaceField, names, names, one_id, short, st.none() | paths)
)
ranges = st.none() | st.tuples(st.integers(-99, 99), st.integers(-99, 99))


@st.composite
def entries(draw: st.DrawFn) -> ObjectEntry:
    limits = draw(ranges)
    return ObjectEntry(
        draw(numbers),
        draw(numbers),
        draw(names),
        draw(plain_types | st.builds(Text, small) | st.builds(Bytes, short)),
        draw(st.sampled_from(Access)),
        constant=draw(st.booleans()),
        volatile=draw(st.booleans()),
        mappable=draw(st.booleans()),
        stored=draw(st.booleans()),
        guarded=draw(st.booleans()),
        maps=draw(st.none() | numbers),
        states=draw(many(names)),
        low=None if limits is None else limits[0],
        high=None if limits is None else limits[1],
        default=draw(st.none() | st.integers(-99, 2**32) | words),
        clauses=draw(some_ids),
    )


fields = st.builds(
    RegisterField,
    names,
    numbers,
    numbers,
    types,
    st.none() | st.builds(Shows, short, optional),
    some_ids,
)
kinds = st.sampled_from(["register", "rule", "row", "define", "property"])
claims = st.integers(0, 3).map(lambda count: tuple(f"A-B-{n:02}" for n in range(8, 8 + count)))
declarations = st.one_of(
    st.builds(Clause, ids, st.sampled_from(Level), words, words, some_ids, st.none() | words),
    st.builds(Manual, words, words, claims),
    st.builds(EsiEntry, words, st.integers(-99, 2**32) | words, some_ids),
    st.builds(
        CodeTable,
        names,
        small,
        st.booleans(),
        many(st.builds(CodeRow, numbers, names, words, some_ids)),
    ),
    st.builds(Parameter, names, types, values, one_id),
    st.builds(Parameter, names, st.just(Time()), st.tuples(st.builds(Literal, numbers)), one_id),
    st.builds(SetParameter, names, st.tuples(st.builds(Literal, numbers, st.just(-1))), one_id),
    st.builds(SetParameter, names, values, one_id),
    st.builds(
        Register,
        names,
        numbers,
        small,
        st.sampled_from(Access),
        st.sampled_from(Access),
        numbers,
        many(fields),
        some_ids,
    ),
    st.builds(Word, names, st.none() | st.tuples(numbers, numbers), small, many(fields), some_ids),
    st.builds(Reason, names, names, names, words, many(short), short, one_id),
    st.builds(
        Frame,
        names,
        st.none(),
        st.just(()),
        many(st.builds(FrameField, names, types, optional, optional, optional, st.none() | paths)),
        some_ids,
    ),
    st.builds(Frame, names, names, many(bindings, 1), st.just(()), some_ids),
    st.builds(Choice, names, words, many(st.builds(Alternative, names, words), 2), one_id),
    st.builds(Condition, names, words, st.booleans(), one_id),
    st.builds(Definition, names, words, expressions, one_id),
    entries(),
    st.builds(Pin, names, names, one_id),
    st.builds(Open, names, one_id),
    st.builds(Confirm, many(st.tuples(kinds, paths), 1), one_id),
    st.builds(Close, names, many(short, 1), one_id),
    changes,
    st.builds(Fault, names, words, one_id, st.none() | names, many(changes)),
    st.builds(Anomaly, ids, names, words, words, words, some_ids),
    st.builds(Example, names, st.binary(max_size=20), st.binary(max_size=20), one_id),
    st.builds(Dictionary, st.booleans(), one_id),
    st.builds(
        Machine,
        names,
        words,
        names,
        many(names, 1),
        names,
        variables,
        many(inputs),
        many(rule),
        many(gap),
    ),
)


def read_apart(chosen: tuple[Declaration, ...]) -> bool:
    """Whether no change follows a fault directly: the parser reads such a change into the fault."""
    return not any(
        isinstance(before, Fault) and isinstance(after, (Replace, Remove, Extend, ReplaceField))
        for before, after in itertools.pairwise(chosen)
    )


bodies = many(declarations).filter(read_apart)
texts = st.builds(SourceText, names, words, st.none() | names, bodies) | st.builds(
    SourceText, names, words, st.none(), bodies, st.just(value=True)
)


@given(expressions)
def test_expression_prints_and_parses_to_the_same(expression: Expression) -> None:
    source = f'standard a "b" define c "d" = {pretty_expression(expression)} [A-1]'
    declaration = parse_text(source, "a").declarations[0]
    assert isinstance(declaration, Definition)
    assert declaration.value == expression


@given(texts)
def test_text_prints_and_parses_to_the_same(text: SourceText) -> None:
    again = parse_text(pretty(text), "a")
    assert again == text
    assert pretty(again) == pretty(text)


@given(st.text())
def test_any_text_that_is_none_is_refused_with_a_place(source: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse_text(f"{source}\n$", "a")
    assert all(found.at.line >= 1 for found in caught.value.diagnostics)


def test_every_function_says_what_it_tells() -> None:
    assert all(signature.wording for signature in FUNCTIONS.values())
