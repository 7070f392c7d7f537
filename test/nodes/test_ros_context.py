# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Start of ROS where its folder for logs cannot be written."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

from t3mpc_ros.nodes.entry_point import provide_log_directory


@pytest.mark.parametrize(
    'given, replaced',
    [
        ({'HOME': 'FOLDER/home'}, False),
        ({'HOME': 'FOLDER/file'}, True),
        ({}, True),
        ({'HOME': 'FOLDER/file', 'ROS_HOME': 'FOLDER/ros'}, False),
        ({'HOME': 'FOLDER/home', 'ROS_HOME': 'FOLDER/file'}, True),
        ({'HOME': 'FOLDER/file', 'ROS_LOG_DIR': 'FOLDER/file/log'}, False),
    ],
)
def test_a_folder_that_cannot_be_written_is_replaced(given, replaced, tmp_path):
    """By a temporary one, unless it is the choice of the user."""
    (tmp_path / 'file').touch()
    given = {name: text.replace('FOLDER', str(tmp_path)) for name, text in given.items()}
    environment = dict(given)
    provide_log_directory(environment)
    assert (environment != given) == replaced
    if replaced:
        made = Path(environment.pop('ROS_LOG_DIR'))
        assert environment == given
        assert f't3mpc_ros-{os.getuid()}' in made.parts


@pytest.mark.slow
def test_ros_starts_without_a_home_folder(tmp_path):
    """Every node said that its command line was invalid."""
    code = 'from t3mpc_ros.nodes.entry_point import init_ros; init_ros([])'
    environment = {k: v for k, v in os.environ.items() if k != 'ROS_LOG_DIR'}
    for home in (str(tmp_path), os.devnull):
        words = [sys.executable, '-c', code]
        done = subprocess.run(words, env=environment | {'HOME': home}, capture_output=True)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / '.ros' / 'log').is_dir()
