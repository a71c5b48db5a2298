"""Inputs of the control in recordings: lines of any age are read, and today's are as they were from the first."""

from __future__ import annotations

import msgspec
import pytest
from trirail.errors import RefusalCode
from trirail.telemetry.recorded_inputs import decode_input, encode_input
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goals import PoseGoal, SlidersGoal
from trirail.wire.looks import AlignmentLook, alignment_event_text
from trirail.wire.messages import GoalReply, Notice
from trirail.wire.packets import (
    Announcement,
    CheckRequest,
    CommandRequest,
    ControlInput,
    DecidedAhead,
    Disturbance,
    GivenInput,
    GoalRequest,
)
from trirail.wire.plan_packets import NotPlanned, PackedPath, PackedRun, PathExtension, PreemptingMotion
from trirail.wire.vocabulary import Command, Override

TAUGHT = coded("pose", EventCode.POSE_REMOVED, pose="x", user="ann")
LOOK = AlignmentLook("a", "check", 1)
LOOKED = alignment_event_text(LOOK, "a look")
RECORDING = coded("hello", EventCode.RECORDING, file="x")
PATH = PackedPath(b"abc", b"defg")
AGAIN = coded("again", EventCode.RECORDED_AGAIN)

LINES: list[tuple[GivenInput, str]] = [
    (DecidedAhead(2), '{"type":"DecidedAhead","cycles":2}'),
    (DecidedAhead(1, again=True), '{"type":"DecidedAhead","cycles":1,"again":true}'),
    (
        Announcement(
            Notice("refused", "warning", "no", user="ann", code=RefusalCode.BUSY, event_code=EventCode.REFUSED)
        ),
        '{"type":"RefusedRequest","user":"ann","message":"no","code":"busy"}',
    ),
    (
        Announcement(Notice("refused", "warning", "no", user="", event_code=EventCode.REFUSED)),
        '{"type":"RefusedRequest","user":"","message":"no","code":null}',
    ),
    (
        Announcement(Notice("pose", "info", TAUGHT.text, user="ann", **TAUGHT.fields)),
        '{"type":"PoseChanged","user":"ann","message":"pose","event_code":"pose_removed",'
        '"params":{"pose":"x","user":"ann"}}',
    ),
    (
        Announcement(Notice("alignment", "info", LOOKED.text, user="ann", alignment=LOOK, **LOOKED.fields)),
        '{"type":"Looked","user":"ann","level":"info","message":"a look",'
        '"look":{"id":"a","purpose":"check","number":1}}',
    ),
    (
        Announcement(Notice("service", "info", RECORDING.text, **RECORDING.fields)),
        '{"type":"Remark","level":"info","message":"hello","event_code":"recording","params":{"file":"x"}}',
    ),
    (
        Announcement(Notice("service", "warning", AGAIN.text, **AGAIN.fields)),
        '{"type":"Remark","level":"warning","message":"again","event_code":"recorded_again","params":{}}',
    ),
    (
        GoalRequest(1, "ann", "g", PoseGoal(0.01, 0.0, 0.0), 5),
        '{"type":"GoalRequest","ticket":1,"user":"ann","id":"g","goal":{"kind":"pose","x":0.01,"y":0.0,"phi":0.0,'
        '"id":null,"speed":1.0,"valid_for":null,"limits":null,"blend":null,"tool":null,"frame":"base"},'
        '"received_ns":5,"withdrawn":null,"age":0.0}',
    ),
    (
        CheckRequest(1, "ann", SlidersGoal((0.01, 0.0, 0.0))),
        '{"type":"CheckRequest","ticket":1,"user":"ann","goal":{"kind":"sliders","position":[0.01,0.0,0.0],'
        '"id":null,"speed":1.0,"valid_for":null,"marks":[],"stop_at":null}}',
    ),
    (
        CommandRequest(2, "ann", Command.OVERRIDE, Override(50.0)),
        '{"type":"CommandRequest","ticket":2,"user":"ann","name":"override","content":{"percent":50.0}}',
    ),
    (
        PreemptingMotion(
            1, 2, None, PackedRun(PATH, PATH, 1.0), GoalReply("", None, stops_first=True, lag=0.25), bound="slider A"
        ),
        '{"type":"Planned","number":1,"version":2,"first":null,'
        '"run":[["YWJj","ZGVmZw==",false,""],["YWJj","ZGVmZw==",false,""],1.0,0.0,[]],"duration":null,"slowed":1.0,'
        '"stops_first":true,"stop":null,"bound":"slider A","lag":0.25}',
    ),
    (
        PathExtension(1, 2, 0.5, PATH, GoalReply("", None, 1.5, queued=True)),
        '{"type":"Extended","number":1,"version":2,"s":0.5,"path":["YWJj","ZGVmZw==",false,""],"slowed":1.5}',
    ),
    (
        NotPlanned(1, 2, RefusalCode.NO_PLAN, "no"),
        '{"type":"NotPlanned","number":1,"version":2,"code":"no_plan","message":"no","slider":null,"value":null,'
        '"limit":null}',
    ),
    (Disturbance("LATE", "x"), '{"type":"Mishap","event":"LATE","reason":"x","event_code":"other","params":{}}'),
]


@pytest.mark.parametrize(("given", "line"), LINES)
def test_an_input_is_recorded_as_it_always_was_and_read_as_it_was_given(given: GivenInput, line: str) -> None:
    what = ControlInput(7, 3, 4, given, urgent=True)
    text = '{"type":"Input","seq":7,"cycle":3,"now_ns":4,"given":' + line + ',"urgent":true,"waiting":false}'
    assert encode_input(what) == text
    assert decode_input(text) == what


@pytest.mark.parametrize(
    "line",
    [
        "[]",
        '{"type":"Input","seq":1,"cycle":1,"now_ns":1,"given":null}',
        '{"type":"Input","seq":1,"cycle":1,"now_ns":1,"given":{"type":"Dance"}}',
        '{"type":"Input","seq":1,"cycle":1,"now_ns":1,"given":{"type":"Looked","user":"ann"}}',
        '{"type":"Input","seq":1,"cycle":1,"now_ns":1,"given":{"type":"Looked","look":1,"message":"a","level":"info"}}',
        '{"type":"Input","seq":1,"seq":1,"cycle":1,"now_ns":1,"given":{"type":"Remark"}}',
        '{"type":"Input"',
    ],
)
def test_what_is_no_input_is_a_decode_error(line: str) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode_input(line)
