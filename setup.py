# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Build description; colcon and pip both read it."""

from glob import glob
import re

from setuptools import find_packages, setup

NAME = 't3mpc_ros'

with open(f'{NAME}/__init__.py', encoding='utf-8') as source:
    VERSION = re.search(r"^__version__ = '([^']+)'", source.read(), re.MULTILINE).group(1)

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
        f'{NAME}.evaluation': ['*.html'],
        f'{NAME}.evaluation.method_comparison': ['*.yaml'],
        f'{NAME}.evaluation.training': ['*.npz'],
        f'{NAME}.evaluation.tuning': ['*.json'],
        f'{NAME}.simulation': ['worlds/*.yaml', 'schedules/*.yaml'],
        f'{NAME}.view': ['page/*'],
    },
    install_requires=[
        'setuptools',
        'numpy',
        'numba',
        'mcap',
        'zstandard',
        'lz4',
        'rosbags',
        'PyYAML',
        'pyserial',
        'matplotlib',
        'cma',
        'daqp',
        'jinja2',
        'tqdm',
    ],
    # colcon test runs pytest only where it is a test dependency.
    extras_require={'nmpc': ['casadi'], 'test': ['pytest']},
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
