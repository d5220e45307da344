# SPDX-License-Identifier: Apache-2.0
"""Core types to messages and back."""
