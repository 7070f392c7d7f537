# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What rerunning a recorded run takes: the journal of the controller, messages in bulk."""
