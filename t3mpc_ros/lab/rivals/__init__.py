# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Other controllers, behind one interface, to be compared with ours on equal terms."""
