# SPDX-License-Identifier: Apache-2.0
"""Package description for colcon (ament_python) and pip alike."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = 'rlml_slam'
NODES = (
    'front_end', 'back_end', 'slam', 'simulator', 'bag_player', 'deformable_slam',
    'ekf_slam', 'reflector_detector',
)  # fmt: skip

ABOUT = ElementTree.parse(Path(__file__).with_name('package.xml')).getroot()
PEOPLE = ABOUT.findall('maintainer')

setup(
    name=NAME,
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
    package_data={NAME: ['py.typed', 'simulation/worlds/*.yaml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    install_requires=[
        'matplotlib',
        'numba',
        'numpy',
        'pillow',
        'pyyaml',
        'rich',
        'rosbags',
        'scipy',
        'setuptools',
    ],
    extras_require={
        # a machine without ROS 2 gets it from wheels
        'ros': ['ros-jazzy-common-interfaces', 'ros-jazzy-rclpy[fastrtps]'],
        'dev': ['hypothesis', 'mypy', 'pytest', 'pytest-xdist', 'ruff'],
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
