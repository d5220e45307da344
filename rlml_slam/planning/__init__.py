# SPDX-License-Identifier: Apache-2.0
"""Plans a layout of reflectors: view, accuracy and uniqueness at each place."""
