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
"""Build description; colcon and pip both read it."""

from contextlib import suppress
from glob import glob
import gzip
import itertools
import os
import re
import runpy
import shutil
import sys
import tarfile

from setuptools import find_packages, setup
from setuptools.command.sdist import sdist

try:
    from setuptools.command.bdist_wheel import bdist_wheel
except ImportError:  # before 70.1, as on Ubuntu 24.04
    try:
        from wheel.bdist_wheel import bdist_wheel
    except ImportError:
        bdist_wheel = None

NAME = 't3mpc_ros'

with open(f'{NAME}/version.py', encoding='utf-8') as source:
    VERSION = re.search(r"^VERSION = '([^']+)'", source.read(), re.MULTILINE).group(1)

NODES = (
    'reference_generator',
    'controller',
    'sim_robot',
    'radio_bridge',
    'recorder',
    'player',
    'localizer',
    'composed',
)
EXECUTABLES = (*NODES, 't3mpc')
PIP_COMMANDS = {'dist_info', 'bdist_wheel', 'editable_wheel'}
"""Commands with which pip builds; colcon uses others, and installs all executables in lib."""


def requirements(file):
    """Return the requirements of a file, without other files and what installs packages."""
    # colcon --symlink-install runs a link to this file in a folder without the others.
    path = os.path.join(os.path.dirname(os.path.realpath(__file__)), file)
    with open(path, encoding='utf-8') as lines:
        found = [line.partition('#')[0].strip() for line in lines]
    return [each for each in found if each and not each.startswith(('-r', 'pip', 'setuptools'))]


# Equal sources give equal distributions, byte for byte, wherever and whenever they are built.
os.environ.setdefault('SOURCE_DATE_EPOCH', '315532800')  # 1980, the first year of a wheel


def mode_of(folder):
    """Return the mode of a folder or file of a distribution, whatever the umask is."""
    return 0o755 if folder else 0o644


class SourceDistribution(sdist):
    """An archive that shows nothing of the time, user and umask of its build."""

    def run(self):
        """Forget the list of files of an earlier build, which is added to the new one."""
        with suppress(FileNotFoundError):
            os.remove(f'{NAME}.egg-info/SOURCES.txt')
        super().run()

    def make_archive(self, base_name, format, root_dir=None, base_dir=None, **_):
        """Write the tree ``base_dir`` to a tar file; return its path."""
        path = f'{base_name}.tar.gz'
        epoch = int(os.environ['SOURCE_DATE_EPOCH'])

        def plain(member):
            member.mtime, member.mode = epoch, mode_of(member.isdir())
            member.uid = member.gid = 0
            member.uname = member.gname = ''
            return member

        os.makedirs(self.dist_dir, exist_ok=True)
        with (
            open(path, 'wb') as file,
            gzip.GzipFile('', 'wb', fileobj=file, mtime=epoch) as packed,
            tarfile.open(fileobj=packed, mode='w', format=tarfile.PAX_FORMAT) as archive,
        ):
            archive.add(base_dir, filter=plain)
        return path


COMMANDS = {'sdist': SourceDistribution}
if bdist_wheel:

    class Wheel(bdist_wheel):
        """A wheel with the executables, without the umask and the time of its build."""

        def write_wheelfile(self, *arguments, **options):
            """Write the last file before the wheel is packed, and set the modes of all."""
            super().write_wheelfile(*arguments, **options)
            for folder, _, files in os.walk(self.bdist_dir or ''):
                for file in files:
                    os.chmod(os.path.join(folder, file), mode_of(folder=False))
            # PATH gets t3mpc only; ros2 run finds the nodes in lib.
            place = f'{self.bdist_dir}/{NAME}-{VERSION}.data/data/lib/{NAME}'
            os.makedirs(place, exist_ok=True)  # left by a build that was interrupted
            for name in EXECUTABLES:
                shutil.copyfile('resource/executable', f'{place}/{name}')
                os.chmod(f'{place}/{name}', 0o755)

    COMMANDS['bdist_wheel'] = Wheel

ROS = [each for each in requirements('requirements.txt') if each.startswith('ros-jazzy-')]
LIBRARIES = runpy.run_path(
    os.path.join(os.path.dirname(os.path.realpath(__file__)), NAME, 'missing_library.py')
)
EXTRAS = {
    extra: [LIBRARIES['REQUIREMENTS'][name] for name in names]
    for extra, names in LIBRARIES['EXTRAS'].items()
}
"""Requirements that a simulation does without, by the extra that installs them."""
NEEDED = [
    each
    for each in requirements('requirements.txt')
    if each not in [*ROS, *itertools.chain(*EXTRAS.values())]
]


FOR_PIP = bool(PIP_COMMANDS.intersection(sys.argv))


def page():
    """Return the page of the package: the README, whose relative links lead nowhere there."""
    path = os.path.join(os.path.dirname(os.path.realpath(__file__)), 'README.md')
    with open(path, encoding='utf-8') as file:
        text = file.read()
    text = re.sub(r'!\[[^\]]*\]\((?!https?:)[^)]*\)\n*', '', text)
    return re.sub(r'\[([^\]]*)\]\((?!https?:)[^)]*\)', r'\1', text)


setup(
    name=NAME,
    version=VERSION,
    cmdclass=COMMANDS,
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
        f'{NAME}.evaluation': ['*.html', '*.css', '*.js', '*.yaml'],
        f'{NAME}.evaluation.patrol': ['*.csv'],
        f'{NAME}.evaluation.training': ['*.npz'],
        f'{NAME}.evaluation.tuning': ['*.json'],
        f'{NAME}.page': ['*.css', '*.js', '*.LICENSE'],
        f'{NAME}.simulation': ['worlds/*.yaml', 'schedules/*.yaml'],
        f'{NAME}.view': ['page/*'],
    },
    install_requires=NEEDED,
    # colcon test runs pytest only where it is a test dependency.
    extras_require={
        **EXTRAS,
        'ros': [*ROS, *EXTRAS['ros'], *EXTRAS['bags']],
        'dev': requirements('requirements-dev.txt'),
        'docs': requirements('requirements-docs.txt'),
        'test': ['pytest'],
    },
    python_requires='>=3.11',
    zip_safe=False,
    maintainer='The t3mpc_ros developers',
    maintainer_email='developers@t3mpc.example',
    description='Type-3 fuzzy, Boltzmann-machine predictive control of a two-wheeled robot '
    'along fractional-order chaotic references.',
    long_description=page(),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    project_urls={'Paper': 'https://doi.org/10.1007/s40747-023-01086-4'},
    keywords='ROS 2, mobile robot, predictive control, type-3 fuzzy system, chaos, MCAP',
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in (11, 12, 13, 14)),
        'Topic :: Scientific/Engineering',
    ],
    entry_points={
        'console_scripts': [
            *(f'{node} = {NAME}.nodes.entry_points:{node}' for node in NODES if not FOR_PIP),
            f't3mpc = {NAME}.cli.entry_point:t3mpc',
        ],
    },
)
