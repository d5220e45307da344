# SPDX-License-Identifier: Apache-2.0
"""``rlml-lab fleet …``: many recordings at once, on a cluster of Dask (extra ``fleet``)."""
