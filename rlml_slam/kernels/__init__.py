# SPDX-License-Identifier: Apache-2.0
"""How kernels are compiled: ahead of time into a library, or with Numba when first called."""
