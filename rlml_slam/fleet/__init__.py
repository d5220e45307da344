# SPDX-License-Identifier: Apache-2.0
"""Many recordings at once, on a cluster of Dask (extra ``fleet``)."""
