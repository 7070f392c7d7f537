# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Build description; colcon and pip both read it."""

from glob import glob
import os
import re

from setuptools import find_packages, setup

NAME = 't3mpc_ros'

with open(f'{NAME}/__init__.py', encoding='utf-8') as source:
    VERSION = re.search(r"^__version__ = '([^']+)'", source.read(), re.MULTILINE).group(1)

ROS = 'ros-jazzy-'


def requirements(file):
    """Return the requirements of a file, without other files and what installs packages."""
    # colcon --symlink-install runs a link to this file in a folder without the others.
    path = os.path.join(os.path.dirname(os.path.realpath(__file__)), file)
    with open(path, encoding='utf-8') as lines:
        found = [line.partition('#')[0].strip() for line in lines]
    return [each for each in found if each and not each.startswith(('-r', 'pip', 'setuptools'))]


NEEDED = requirements('requirements.txt')

setup(
    name=NAME,
    version=VERSION,
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    # Stated, so that an editable installation is a path and not an import hook.
    package_dir={'': '.'},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    package_data={
        NAME: ['py.typed'],
        # A link in the repository; the emulator compiles them.
        f'{NAME}.emulator': ['firmware/core/*.[ch]', 'firmware/host/*.[ch]'],
        f'{NAME}.evaluation': ['*.html', '*.css', '*.js'],
        f'{NAME}.evaluation.method_comparison': ['*.yaml'],
        f'{NAME}.evaluation.patrol': ['*.csv'],
        f'{NAME}.evaluation.training': ['*.npz'],
        f'{NAME}.evaluation.tuning': ['*.json'],
        f'{NAME}.page': ['*.css', '*.js', '*.LICENSE'],
        f'{NAME}.simulation': ['worlds/*.yaml', 'schedules/*.yaml'],
        f'{NAME}.view': ['page/*'],
    },
    install_requires=['setuptools', *(each for each in NEEDED if not each.startswith(ROS))],
    # colcon test runs pytest only where it is a test dependency.
    extras_require={
        'ros': [each for each in NEEDED if each.startswith(ROS)],
        'compare': ['casadi>=3.6', 'pyarrow>=15'],
        'cluster': ['distributed>=2024.5', 'pyarrow>=15'],
        'dev': requirements('requirements-dev.txt'),
        'test': ['pytest'],
    },
    python_requires='>=3.11',
    zip_safe=False,
    maintainer='The t3mpc_ros developers',
    maintainer_email='developers@t3mpc.example',
    description='Type-3 fuzzy, Boltzmann-machine predictive control of a two-wheeled robot '
    'along fractional-order chaotic references.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            f'reference_generator = {NAME}.nodes.common.entry_point:reference_generator',
            f'controller = {NAME}.nodes.common.entry_point:controller',
            f'sim_robot = {NAME}.nodes.common.entry_point:sim_robot',
            f'radio_bridge = {NAME}.nodes.common.entry_point:radio_bridge',
            f'recorder = {NAME}.nodes.common.entry_point:recorder',
            f'player = {NAME}.nodes.common.entry_point:player',
            f'composed = {NAME}.nodes.common.entry_point:composed',
            f't3mpc = {NAME}.cli.main:main',
        ],
    },
)
