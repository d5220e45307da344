# SPDX-License-Identifier: Apache-2.0
"""Package description for colcon (ament_python) and pip alike."""

import os
import subprocess
import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import Distribution, find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.develop import develop

NAME = 'rlml_slam'
NODES = (
    'front_end', 'back_end', 'slam', 'simulator', 'bag_player', 'deformable_slam',
    'ekf_slam', 'reflector_detector',
)  # fmt: skip

ABOUT = ElementTree.parse(Path(__file__).with_name('package.xml')).getroot()
PEOPLE = ABOUT.findall('maintainer')


class WithKernels(Distribution):
    """The library of kernels is of one machine's kind."""

    def has_ext_modules(self):
        """Whether a wheel is of one platform."""
        return True


class BuildWithKernels(build_py):
    """The sources, and the library that is compiled from them."""

    def run(self):
        """Copy, then compile in the copy; an editable package compiles by `rlml warm-up`."""
        super().run()
        if not self.editable_mode:
            compile_kernels(os.path.abspath(self.build_lib))


class DevelopWithKernels(develop):
    """What `colcon build --symlink-install` runs."""

    def run(self):
        """Link, then compile beside the sources."""
        super().run()
        compile_kernels(os.path.dirname(os.path.realpath(NAME)))


def compile_kernels(root):
    """Compile the library into the package in ``root``, where there are Numba and a compiler."""
    command = [sys.executable, '-m', NAME, 'warm-up', '--into', os.path.join(root, NAME)]
    path = os.pathsep.join([root, *filter(None, [os.environ.get('PYTHONPATH')])])
    done = subprocess.run(command, cwd=root, env={**os.environ, 'PYTHONPATH': path}, check=False)
    if done.returncode:
        print('the kernels are compiled when they are first called, or by `rlml warm-up`')


setup(
    name=NAME,
    distclass=WithKernels,
    cmdclass={'build_py': BuildWithKernels, 'develop': DevelopWithKernels},
    version=ABOUT.findtext('version'),
    description=ABOUT.findtext('description'),
    author=', '.join(p.text for p in PEOPLE),
    maintainer=', '.join(p.text for p in PEOPLE),
    maintainer_email=', '.join(p.get('email') for p in PEOPLE),
    url=ABOUT.findtext("url[@type='website']"),
    project_urls={u.get('type'): u.text for u in ABOUT.findall('url')},
    license=ABOUT.findtext('license'),
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={
        NAME: [
            'py.typed',
            'kernels/table.c',
            'simulation/worlds/*.yaml',
            'report/page.css',
            'report/viewer/viewer.css',
            'report/viewer/viewer.js',
        ]
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    install_requires=[
        'apsw',
        'argcomplete',
        'bokeh',
        'matplotlib',
        'numba',
        'numpy',
        'pillow',
        'pyyaml',
        'rich',
        'rosbags',
        'scipy',
        'setuptools',
        'tornado',
    ],
    extras_require={
        # a machine without ROS 2 gets it from wheels
        'ros': ['ros-jazzy-common-interfaces', 'ros-jazzy-rclpy[fastrtps]'],
        'dev': [
            'hypothesis',
            'mcap',
            'mcap-ros2-support',
            'mypy',
            'pytest',
            'pytest-xdist',
            'ruff',
        ],
        # many maps at once (`rlml map merge`), and many recordings from a checkout
        'fleet': ['dask', 'distributed', 'fsspec', 'pyarrow'],
        'bench': ['evo', 'g2o-python', 'g2opy', 'gtsam', 'pyceres', 'yag-slam'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'rlml = rlml_slam.cli.main:main',
            *(f'{node} = {NAME}.nodes.{node}:main' for node in NODES),
        ],
    },
)
