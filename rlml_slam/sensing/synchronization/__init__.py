# SPDX-License-Identifier: Apache-2.0
"""Inputs in any order become observations in the order of their stamps."""
