# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag train BAG ...``: a model file from recorded runs, and what it is worth on the others."""

import argparse
from pathlib import Path

from t3mpc_ros.lab.training.command import add_bag_options, run_bags


def add_train_parser(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    """Add ``train`` to the commands of ``bag``; ``options.run(options)`` carries it out."""
    parser = commands.add_parser(
        'train',
        help='learn a model file that the controller starts from',
        description='Learns the weights of the predictor and the first fuzzy coefficients from '
        "one or more bags that were recorded with this package's controller, and tells by "
        'cross-validation what they are worth on runs that they were not learnt from. The '
        'controller loads the file by its parameter model. While the bags are recorded, '
        "the controller's predictive.dither should be a few rad/s².",
    )
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='folder of a bag')
    add_bag_options(parser)
    parser.set_defaults(run=run_bags)
