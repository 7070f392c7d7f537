# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``lab train`` and ``bag train``: the command lines of learning beforehand."""

import argparse
from pathlib import Path
import sys

DRIVES = ('velocity', 'torque')
OUTPUT = Path('model.npz')
SEEDS = 5
FOLDS = 5


def add_parser(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    """Add ``train`` to the commands of ``lab``; :func:`run` carries it out."""
    parser = commands.add_parser(
        'train',
        help='make a model file that the controller starts from',
        description='Without a bag: what the full controller learns in simulated practice, and '
        'what that is worth on other seeds. With bags: the same as bag train. The controller '
        'loads the file by its parameter model.',
    )
    parser.add_argument('bags', nargs='*', type=Path, metavar='BAG', help='folder of a bag')
    parser.add_argument(
        '--drive', choices=DRIVES, default='velocity', help='of the practice (default velocity)'
    )
    parser.add_argument(
        '--seeds',
        type=int,
        default=SEEDS,
        help=f'runs with and without the model after the practice (default {SEEDS})',
    )
    add_bag_options(parser)
    parser.set_defaults(run=run)


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of learning from bags, see :func:`run_bags`."""
    parser.add_argument(
        '--output', type=Path, default=OUTPUT, help=f'model file to write (default {OUTPUT})'
    )
    parser.add_argument(
        '--keep-predictor',
        action='store_true',
        help='learn only the fuzzy coefficients from the bags, because v_p moved too little',
    )
    parser.add_argument(
        '--folds',
        type=int,
        default=FOLDS,
        help='blocks into which one bag alone is cut to be cross-validated; of several bags '
        f'each is a fold (default {FOLDS})',
    )


def run(options: argparse.Namespace) -> int:
    """Return 0 when the model was written; prints what it is worth.

    Raises
    ------
    TrainingError
        The bags do not teach anything.
    ModelError
        The file cannot be written.
    ValueError
        Options that do not go together.
    """
    from t3mpc_ros.record.model import save_model

    if options.bags:
        if options.drive != 'velocity':
            raise ValueError(f'drive must be velocity for bags: got {options.drive}')
        return run_bags(options)
    from t3mpc_ros.lab.training.practice import assess, held_out_seeds, learn_from_practice

    if options.keep_predictor:
        raise ValueError('--keep-predictor is for bags')
    seeds = held_out_seeds(options.seeds)
    practised, used = learn_from_practice(options.drive)
    save_model(options.output, practised, {**used.flat(), 'drive': options.drive})
    print(assess(options.drive, used, practised, seeds, _tell))
    print(f'saved {options.output.resolve()}')
    return 0


def run_bags(options: argparse.Namespace) -> int:
    """Return 0 when the model of ``options.bags`` was written; prints what it is worth.

    Raises as :func:`run`.
    """
    from t3mpc_ros.lab.training.bags import learn_from_bags
    from t3mpc_ros.record.model import save_model

    model = learn_from_bags(
        options.bags, keep_predictor=options.keep_predictor, count=options.folds
    )
    print(model.text)
    save_model(options.output, model.learnt, model.settings.flat(), model.origin)
    print(f'saved {options.output.resolve()}')
    return 0


def _tell(text: str) -> None:
    print(f'  {text}', file=sys.stderr, flush=True)
