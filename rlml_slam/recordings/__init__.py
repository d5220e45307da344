# SPDX-License-Identifier: Apache-2.0
"""A bag through a whole system: what the command, the Python API and studies drive."""
