# SPDX-License-Identifier: Apache-2.0
"""A drive over DDS: a source of sensor data, front end and back end as processes, heard here."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rclpy
import rclpy.utilities
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from rlml_slam import warm_up
from rlml_slam.cli.support import live_map
from rlml_slam.cli.support.live_bag import LiveBag
from rlml_slam.cli.support.processes import Processes, free_domain
from rlml_slam.cli.support.progress import Progress
from rlml_slam.cli.support.recorder import Recorder
from rlml_slam.cli.support.usage import Usage, summary
from rlml_slam.errors import RlmlError
from rlml_slam.evaluation.metrics import distribution
from rlml_slam.evaluation.run_record import Run
from rlml_slam.interrupts import held_interrupts
from rlml_slam.ros.bags.bag import BagWriter

START_TIMEOUT = 90.0  # [s] for three processes to start and to find each other
SILENCE = 15.0  # [s] without a pose while the source runs: something is broken
SYSTEM = ('front_end', 'back_end')
LISTENERS = 2  # of the sensor: front end and recorder; time begins when both are there


@dataclass(frozen=True)
class Source:
    """What takes the place of a robot: an executable of this package with its parameters.

    ``system`` are parameters of the ``nodes``, ``config`` their parameter file.
    ``sensor`` is the (topic, type) whose every message asks for a pose. ``progress`` shows the
    share of the drive that is done. ``keeps_map``: the run gets the whole map at its end.
    ``mcap`` is a file for all that was heard, ``inputs`` the types of the topics that it needs
    besides those of our nodes. On ``view_port`` a browser
    can watch meanwhile.
    """

    title: str
    executable: str
    parameters: Mapping[str, Any]
    progress: Callable[[Recorder], float]
    system: Mapping[str, Any] = field(default_factory=dict)
    config: Path | None = None
    sensor: tuple[str, str] = ('scan', 'sensor_msgs/msg/LaserScan')
    keeps_map: bool = False
    mcap: Path | None = None
    inputs: Mapping[str, str] = field(default_factory=dict)
    view_port: int | None = None
    nodes: tuple[str, ...] = SYSTEM


def drive(source: Source, out: Path, quiet: bool) -> Run:
    """One drive over DDS in a domain of its own; the logs of the processes go to ``out``/log.

    Raises RlmlError if a process dies, never answers or falls silent, with its last words.
    """
    _compile(quiet)
    domain, problem = free_domain(), ''
    environment = {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with (
        own_domain(domain, environment),
        held_interrupts() as check,
        tempfile.TemporaryDirectory(prefix='rlml_map_') as maps,
        ExitStack() as files,
        Processes(out / 'log', environment) as processes,
    ):
        recorder = Recorder(source.sensor)
        if source.mcap is not None:
            writer = files.enter_context(BagWriter(source.mcap))
            recorder.bag = LiveBag(writer, source.inputs, source.sensor[0])
        executor = SingleThreadedExecutor()
        executor.add_node(recorder)
        try:
            _start(processes, source, maps)
            load = Load(processes, source.nodes)
            with Progress('driving', 1.0, quiet) as progress:
                for _ in _listen(processes, recorder, executor, source):
                    check()
                    load.sample(recorder)
                    progress.update(source.progress(recorder), recorder.note())
            if not recorder.frames.stamps:
                raise RlmlError('the front end never published a pose')
            if source.keeps_map:
                problem = live_map.save(recorder, executor, check)
        finally:
            executor.shutdown(timeout_sec=1.0)
            recorder.destroy_node()
        result = recorder.run(source.title)
        if source.keeps_map and not problem:
            problem = live_map.take(result, Path(maps))
    result.problem = problem
    result.extra = _live_figures(recorder, load)
    return result


@contextmanager
def own_domain(domain: int, environment: Mapping[str, str]) -> Iterator[None]:
    """ROS in this process, in that domain alone; the environment is as before afterwards."""
    before = dict(os.environ)
    os.environ.update(environment)
    rclpy.init(args=[], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.utilities.try_shutdown()
        os.environ.clear()
        os.environ.update(before)


def _compile(quiet: bool) -> None:
    """What the processes need, once and not by each of them at the same time."""
    warm_up.import_core(also_others=False)
    modules = warm_up.loaded()
    with Progress('compiling, once', len(modules), quiet) as progress:
        for k, (name, compile_module) in enumerate(modules):
            progress.update(k, name.removeprefix('rlml_slam.'))
            compile_module()


def _start(processes: Processes, source: Source, maps: str) -> None:
    """All nodes; the source waits until the others listen."""
    system = dict(source.system)
    if source.keeps_map:
        system |= {'map_directory': maps, 'map_file_name': live_map.NAME}
    if source.view_port is not None:
        # nobody asks how it is: a viewer that ends costs the drive nothing
        processes.start('view', ['rlml_slam', 'view', '--port', str(source.view_port)])
    for name in source.nodes:
        processes.start(name, node(name, system, source.config))
    processes.start(source.executable, node(source.executable, source.parameters))


def node(name: str, parameters: Mapping[str, Any], config: Path | None = None) -> list[str]:
    """Arguments of ``python -m`` for an executable of this package."""
    words = [f'rlml_slam.nodes.{name}', '--ros-args', '--log-level', 'warn']
    if config is not None:
        words += ['--params-file', str(config)]
    for key, value in parameters.items():
        words += ['-p', f'{key}:={value}']
    return words


def _listen(
    processes: Processes, recorder: Recorder, executor: SingleThreadedExecutor, source: Source
) -> Iterator[None]:
    """Hear the whole drive, bit by bit; RlmlError if a process dies or falls silent."""
    began = time.monotonic()
    finished: float | None = None
    while finished is None or not recorder.has_caught_up(finished):
        executor.spin_once(timeout_sec=0.1)
        now = time.monotonic()
        recorder.is_ready()
        processes.check(*source.nodes)
        if finished is None and processes.has_ended(source.executable):
            finished = now
        if not recorder.frames.stamps and now - began > START_TIMEOUT:
            raise RlmlError(f'no pose within {START_TIMEOUT:g} s of the start')
        if finished is None and recorder.silence(now) > SILENCE:
            raise RlmlError(f'the front end has been silent for {SILENCE:g} s')
        yield


class Load:
    """CPU time and memory of the system's nodes, from the first pose on."""

    def __init__(self, processes: Processes, nodes: Sequence[str]) -> None:
        self._processes = processes
        self._samples: dict[str, list[Usage]] = {name: [] for name in nodes}
        self._due = 0.0

    def sample(self, recorder: Recorder) -> None:
        """Look once a second while poses come."""
        now = time.monotonic()
        if not recorder.frames.stamps or now < self._due:
            return
        self._due = now + 1.0
        for name, samples in self._samples.items():
            seen = self._processes.usage(name)
            if seen is not None:
                samples.append(seen)

    def summary(self) -> dict[str, dict[str, Any]]:
        """By node; empty where the system does not say."""
        return {name: summary(samples) for name, samples in self._samples.items() if samples}


def _live_figures(recorder: Recorder, load: Load) -> dict[str, Any]:
    """What only a live run has: scans sent, the time from a scan to its pose, and the load."""
    figures: dict[str, Any] = {'scans_published': recorder.sent()}
    if recorder.latency_ms:
        figures['latency_ms'] = distribution(recorder.latency_ms)
    nodes = load.summary()
    if nodes:
        figures['nodes'] = nodes
        figures['peak_rss_mb'] = round(sum(n['peak_rss_mb'] for n in nodes.values()), 1)
    return figures
