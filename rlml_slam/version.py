# SPDX-License-Identifier: Apache-2.0
"""Version of the package, as in setup.py and package.xml."""

__version__ = '0.1.0'
