# SPDX-License-Identifier: Apache-2.0
# %% [markdown]
# # From a bag to a map, in Python
# Each `# %%` begins a cell: open this file in Jupyter (jupytext), VS Code or Spyder, or run it
# with Python from the folder of the repository.

# %%
import tempfile
from pathlib import Path

import numpy as np

import rlml_slam

bag = rlml_slam.read_bag('bags/room')
print(f'{(bag.end - bag.start) * 1e-9:.0f} s, topics {bag.topics}')

# %% Replay it: the trajectory, its covariances and the map are arrays.
result = rlml_slam.replay(bag)
x, y, theta = result.poses.T  # map frame, [m] and [rad]
sigma_xy = np.sqrt(result.covariances[:, [0, 1], [0, 1]])  # of the live poses [m]
print(f'{len(result.poses)} poses, the last at ({x[-1]:.2f}, {y[-1]:.2f}) m')
print(f'largest standard deviation {sigma_xy.max():.3f} m')

# %% Compare it with the ground truth of the bag.
errors = rlml_slam.evaluate(result)
print(f'position rmse {errors["rmse_m"]:.4f} m, heading {errors["heading_rmse_deg"]:.3f} deg')

# %% The map: reflectors with covariances, and an occupancy grid.
reflectors, grid = result.map.reflectors, result.map.grid
for point, cov in zip(reflectors.points, reflectors.cov, strict=True):
    print(f'reflector at ({point[0]:.2f}, {point[1]:.2f}) m ± {np.sqrt(np.trace(cov)):.3f} m')
assert grid is not None  # there are scans in this bag
occupied = np.argwhere(grid.cells > 65)[:, ::-1]  # (column, row)
walls = np.array(grid.origin) + (occupied + 0.5) * grid.resolution  # (n, 2) [m]

# %% Save the map, load it, and localize in it.
folder = Path(tempfile.mkdtemp())
rlml_slam.save_map(result.map, folder / 'room.rlml')
room = rlml_slam.load_map(folder / 'room.rlml')
localized = rlml_slam.replay(bag, localize_in=room)
print(f'localized: rmse {rlml_slam.evaluate(localized)["rmse_m"]:.4f} m')

# %% Change parameters: by the names of the ROS parameters, checked as they are set.
without_odometry = rlml_slam.read_parameters(changes={'use_odom': False})
result = rlml_slam.replay(bag, without_odometry)
print(f'without odometry: rmse {rlml_slam.evaluate(result)["rmse_m"]:.4f} m')

# %% Drive the system yourself: measurement in, frames out. Measurements may come from a bag, from
# a driver or from arrays (Scan, Odometry, Imu and Detections of rlml_slam.types).
slam = rlml_slam.Slam(sensor_poses=bag.sensor_poses)
for measurement in bag:
    for frame in slam.add(measurement):
        if frame.health.reasons:
            print(frame.stamp, frame.health)
result = slam.finish()

# %% An error says what happened, where, and what to do.
try:
    rlml_slam.replay('bags/kitchen')
except rlml_slam.RlmlError as error:
    print(error)
