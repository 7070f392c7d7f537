# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""``t3mpc robot doctor``: the bench checklist, measured and asked, with a report."""

import argparse
from collections.abc import Callable, Sequence
import os
from pathlib import Path
from typing import TypeVar

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation import html_page, result_output
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.tool import link_test, manoeuvre, procedure
from t3mpc_ros.radio.tool.bench_checklist import (
    DRIVEN,
    QUESTIONS,
    Question,
    check_board,
    check_builds,
    examine_board,
)
from t3mpc_ros.radio.tool.link_test import FAIL, PASS, POOR, SKIPPED, Check
from t3mpc_ros.radio.tool.procedure import DONGLE, ROBOT_BOARD, Board, ProcedureError, Script

Value = TypeVar('Value')
Answer = Callable[[str], str]
"""Asks a question; returns ``yes``, ``no`` or ``skip``."""
_MARKS = {PASS: 'yes', POOR: 'open', FAIL: 'no', SKIPPED: 'open'}
_SPEED = 2.0
"""rad/s, of the wheels in the air"""


def run_doctor(
    options: argparse.Namespace,
    parameters: LinkParameters,
    key: bytes,
    answer: Answer,
    interrupted: Callable[[], bool],
) -> list[Check]:
    """Go through the checklist; print each line, write the report, return all lines."""
    checks: list[Check] = []

    def add(new: Sequence[Check]) -> None:
        for check in new:
            checks.append(check)
            print(format_check(check), flush=True)

    def run(script: Script[Value], name: str, board: Board) -> Value | None:
        port = options.robot_port if board is ROBOT_BOARD else options.port
        try:
            return procedure.run_script(script, port, interrupted, board)
        except ProcedureError as error:
            if interrupted():
                raise
            add([Check(2, name, FAIL, 'no result', str(error))])
            return None

    board = run(examine_board(), 'USB of the robot', ROBOT_BOARD)
    if board is not None:
        add(check_board(board, parameters))
    dongle = run(procedure.wait_for_board('no board answers on this port'), 'dongle', DONGLE)
    add([check_builds(dongle, board.pong if board is not None else None)])
    if dongle is not None:
        result = run(link_test.run_link_test(parameters, options.count), 'link', DONGLE)
        if result is not None:
            add(link_test.evaluate(result, parameters))
    if options.drive:
        _drive(options, parameters, key, answer, interrupted, add)
    else:
        add([_skip(question, 'needs --drive') for question in DRIVEN])
    for question in QUESTIONS:
        add([_judge(question, answer(question.text))])
    _write(checks, options.report)
    return checks


def format_check(check: Check) -> str:
    """Return a line of the output, with the remedy of what is not good."""
    step = f'{check.step:>2}' if check.step else '  '
    text = f'{step}  {check.verdict:<7}  {check.name}: {check.value}'
    return f'{text}\n             try: {check.remedy}' if check.verdict in (POOR, FAIL) else text


def _drive(
    options: argparse.Namespace,
    parameters: LinkParameters,
    key: bytes,
    answer: Answer,
    interrupted: Callable[[], bool],
    add: Callable[[Sequence[Check]], None],
) -> None:
    for question, wheel in zip(DRIVEN, (manoeuvre.LEFT, manoeuvre.RIGHT), strict=True):
        ready = f'The {wheel} wheel will make one turn. Both wheels in the air, hands away?'
        if answer(ready) != 'yes':
            add([_skip(question, 'not confirmed')])
            continue
        task = manoeuvre.Jog(parameters, key, os.urandom, wheel, 1.0, _SPEED, print)
        procedure.run_at_port(task, options.port, interrupted)
        if interrupted():
            raise ProcedureError('interrupted')
        if task.error:
            add([Check(question.step, question.name, FAIL, 'did not turn', task.error)])
        else:
            add([_judge(question, answer(question.text))])


def _skip(question: Question, why: str) -> Check:
    return Check(question.step, question.name, SKIPPED, why, question.remedy)


def _judge(question: Question, answer: str) -> Check:
    verdict = {'yes': PASS, 'no': FAIL}.get(answer, SKIPPED)
    value = 'not answered' if verdict == SKIPPED else answer
    return Check(question.step, question.name, verdict, value, question.remedy)


def _write(checks: Sequence[Check], path: Path) -> None:
    counts = {verdict: sum(c.verdict == verdict for c in checks) for verdict in _MARKS}
    failed = [f'{check.name}: {check.remedy}' for check in checks if check.verdict == FAIL]
    kind = 'bad' if failed else 'open' if counts[POOR] or counts[SKIPPED] else 'good'
    headline = {
        'bad': f'{counts[FAIL]} of {len(checks)} checks failed',
        'open': f'nothing failed; poor: {counts[POOR]}, skipped: {counts[SKIPPED]}',
        'good': 'all checks passed',
    }[kind]
    rows: list[list[str | result_output.Mark]] = [
        [
            check.name,
            result_output.Mark(check.verdict, _MARKS[check.verdict]),
            str(check.step or ''),
            check.value,
            check.remedy if check.verdict in (POOR, FAIL) else '',
        ]
        for check in checks
    ]
    blocks: list[html_page.Block] = [
        html_page.VerdictBox(headline, failed, kind),
        html_page.Tiles([(str(count), verdict) for verdict, count in counts.items()]),
        result_output.Table(
            '', ['check', 'verdict', 'step', 'found', 'remedy'], rows, text=5, wrap=True
        ),
    ]
    print(headline, flush=True)
    data = path.with_suffix('.json')
    page = html_page.html_page('Bench checklist of the robot', blocks)
    numbers = result_output.strict_json([check._asdict() for check in checks])
    write_atomically(path, page)
    write_atomically(data, numbers)
    print(f'{path}, {data}: saved')
