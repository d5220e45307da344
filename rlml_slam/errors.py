# SPDX-License-Identifier: Apache-2.0
"""Every error that a user can cause or meet: one root, one line that names what and where."""


class RlmlError(Exception):
    """Root of all expected errors; the command line prints it as one line and exits with 1."""


class ParameterError(RlmlError):
    """A parameter is unknown, of the wrong type or out of its bounds."""


class InputError(RlmlError):
    """A message or measurement is invalid (NaN, wrong frame, wrong shape, bad stamp)."""


class BagError(RlmlError):
    """A bag cannot be read or written, or lacks what is needed."""


class FileFormatError(RlmlError):
    """A text or data file (CARMEN, TUM, relations, g2o, world, YAML) is malformed."""


class MapError(RlmlError):
    """A map cannot be saved, loaded or used."""


class NoMapError(MapError):
    """There is no map of that name."""


class SolverError(RlmlError):
    """A graph is malformed, or its normal equations cannot be solved."""


class ClusterError(RlmlError):
    """A cluster cannot be reached, or its workers cannot be used."""


def cause(error: Exception) -> str:
    """What went wrong with a file, without the name of the file that an OSError repeats."""
    return str(getattr(error, 'strerror', None) or error)
