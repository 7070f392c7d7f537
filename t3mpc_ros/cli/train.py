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
"""``t3mpc train``: fits a model file to simulated runs."""

import argparse
from pathlib import Path

from t3mpc_ros.cli.shared_options import Commands, add_seeds
from t3mpc_ros.parameters.command_line import bounded_int, check_writable

DRIVES = {'servo': 'velocity', 'torque': 'torque'}
OUTPUT = Path('model.npz')
SEEDS = '101-105'
FOLDS = 5


def add_parser(commands: Commands) -> None:
    """Add the subcommand ``train``."""
    parser = commands.add_parser(
        'train',
        help='make a model file that the controller starts from',
        description='Without a bag: fits the model of the full controller to simulated runs and '
        'reports its skill on held-out seeds. With bags: the same as bag train. The controller '
        'loads the file by its parameter model.',
    )
    parser.add_argument('bags', nargs='*', type=Path, metavar='BAG', help='folder of a bag')
    parser.add_argument(
        '--robot', choices=DRIVES, default='servo', help='of the training runs (default servo)'
    )
    add_seeds(parser, SEEDS, 'the runs with and without the model afterwards', counted=True)
    add_bag_options(parser)
    parser.set_defaults(run=run)


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of training from bags, see :func:`run_bags`."""
    add = parser.add_argument
    add('--output', type=Path, default=OUTPUT, help=f'model file to write (default {OUTPUT})')
    text = 'learn only the fuzzy coefficients from the bags, because v_p moved too little'
    add('--keep-predictor', action='store_true', help=text)
    text = (
        'blocks into which one bag alone is cut to be cross-validated; of several bags '
        f'each is a fold (default {FOLDS})'
    )
    add('--folds', type=bounded_int(2, 1000), default=FOLDS, help=text)


def run(options: argparse.Namespace) -> None:
    """Write the model and print its skill."""
    from t3mpc_ros.model_file import save_model

    if options.bags:
        if options.robot != 'servo':
            raise ValueError(f'robot must be servo for bags: got {options.robot}')
        run_bags(options)
        return
    from t3mpc_ros.evaluation.training.train_models import assess, fit_simulated_runs, origin

    if options.keep_predictor:
        raise ValueError('--keep-predictor is for bags')
    check_writable(options.output)
    drive = DRIVES[options.robot]
    pretrained, used = fit_simulated_runs(drive)
    save_model(options.output, pretrained, {**used.to_dict(), 'drive': drive}, origin(drive))
    print(assess(drive, options.seeds, progress=True))
    print(f'saved {options.output.resolve()}')


def run_bags(options: argparse.Namespace) -> None:
    """Write the model of ``options.bags`` and print its skill."""
    from t3mpc_ros.evaluation.training.train_models import fit_bags
    from t3mpc_ros.model_file import save_model

    check_writable(options.output)
    model = fit_bags(options.bags, keep_predictor=options.keep_predictor, count=options.folds)
    print(model.text)
    save_model(options.output, model.learnt, model.parameters.to_dict(), model.origin)
    print(f'saved {options.output.resolve()}')
