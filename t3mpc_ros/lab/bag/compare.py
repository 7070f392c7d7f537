# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag compare``: recorded against computed again, or two bags of one run, field by field."""

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from t3mpc_ros.lab.bag.rerun import add_input_options
from t3mpc_ros.settings.words import from_words

if TYPE_CHECKING:
    from t3mpc_ros.lab.rerun.compare import Tolerances

SAME, DIFFERS = 0, 3
"""Exit codes; an error is 1, as for every command."""


def add_compare_parser(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    """Add ``compare`` to the commands of ``bag``; :func:`run` carries it out."""
    parser = commands.add_parser(
        'compare',
        help='compare a recorded run with its rerun, or with another bag',
        description='With one bag: it is computed again, see bag rerun, and each field compared. '
        'With two: what they hold of one run. Exit code 0: all within the tolerances; 3: '
        'something differs; 1: it cannot be compared.',
    )
    parser.add_argument(
        'bag', type=Path, nargs='?', metavar='BAG', help='folder of the bag, or its file'
    )
    parser.add_argument('other', type=Path, nargs='?', metavar='OTHER', help='another bag')
    parser.add_argument(
        '--abs',
        type=float,
        metavar='TOL',
        help='absolute tolerance, SI units (default 1e-9; elsewhere than where it was recorded '
        'take 1e-6)',
    )
    parser.add_argument(
        '--rel', type=float, metavar='TOL', help='share of the recorded number (default 1e-9)'
    )
    parser.add_argument(
        '--field',
        dest='fields',
        action='append',
        default=[],
        metavar='F=TOL',
        help='absolute tolerance of one field, or of several by a name with *; may be given again',
    )
    parser.add_argument(
        '--picture', type=Path, metavar='FILE', help='draw the first divergence as PNG'
    )
    parser.add_argument(
        '--update-golden',
        type=Path,
        metavar='FOLDER',
        help='compare nothing: make the golden bags anew, test/golden say, on purpose',
    )
    add_input_options(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Return 0 when all is within the tolerances, 3 when something differs; prints the table.

    Raises
    ------
    RerunError
        Nothing can be compared.
    RecordError
        A bag cannot be read.
    ValueError
        A tolerance or setting cannot be used, or there is no bag.
    """
    from t3mpc_ros.control.controller import ControllerSettings
    from t3mpc_ros.lab.rerun.compare import compare, compare_bags
    from t3mpc_ros.lab.rerun.golden import write_golden
    from t3mpc_ros.lab.rerun.inputs import load_inputs
    from t3mpc_ros.lab.rerun.picture import write_picture
    from t3mpc_ros.lab.rerun.rerun import OPEN_LOOP, rerun
    from t3mpc_ros.record.model import load_model

    if options.update_golden:
        write_golden(options.update_golden)
        return SAME
    if options.bag is None:
        raise ValueError('BAG must be given, or --update-golden')
    tolerances = tolerances_from(options.abs, options.rel, options.fields)
    changes = from_words(ControllerSettings, options.settings)
    model = load_model(options.model) if options.model else None
    inputs = load_inputs(options.bag, options.namespace, model)
    if options.other is not None:
        if changes or model:
            raise ValueError('--set and --model are for a rerun: give one bag only')
        other = load_inputs(options.other, options.namespace)
        outcome = compare_bags(inputs, other, tolerances)
    else:
        outcome = compare(inputs, rerun(inputs, changes), tolerances)
    print(outcome.table())
    if changes or model:
        print(OPEN_LOOP)
    if options.picture:
        write_picture(outcome, options.picture)
        print(f'drawn to {options.picture}', file=sys.stderr)
    return SAME if outcome.same else DIFFERS


def tolerances_from(
    absolute: float | None, relative: float | None, fields: Sequence[str]
) -> 'Tolerances':
    """Return the tolerances that a command line asks for.

    Raises
    ------
    ValueError
        A text is not ``FIELD=NUMBER``, or a tolerance cannot be used.
    """
    from t3mpc_ros.lab.rerun.compare import ABSOLUTE, RELATIVE, Tolerances

    own = {}
    for text in fields:
        name, _, value = text.rpartition('=')
        try:
            own[name] = float(value)
        except ValueError:
            raise ValueError(f'--field must be FIELD=NUMBER: got {text!r}') from None
    return Tolerances(
        ABSOLUTE if absolute is None else absolute, RELATIVE if relative is None else relative, own
    )
