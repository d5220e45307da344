# SPDX-License-Identifier: Apache-2.0
"""The study of the LEGO robot among cylinders."""
