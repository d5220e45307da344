# SPDX-License-Identifier: Apache-2.0
"""Maps of made observations."""

from rlml_slam.params import Parameters
from rlml_slam.slam.back_end.back_end import BackEnd
from rlml_slam.slam.front_end.front_end import FrontEnd


def whole(observed, params=None):
    """The back end behind a real front end, as Slam has it."""
    params = params or Parameters()
    front_end, back_end = FrontEnd(params), BackEnd(params)
    for o in observed:
        update = back_end.add(front_end.process(o))
        if update is not None and update.optimized:
            front_end.correct(update.T_map_local)
    back_end.finish()
    return back_end
