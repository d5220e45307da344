# SPDX-License-Identifier: Apache-2.0
"""Studies and benchmarks: the laboratory of rlml_slam."""
