# SPDX-License-Identifier: Apache-2.0
"""The live front end."""
