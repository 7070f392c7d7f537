# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Motors, wheels, body and disturbances of the simulated robot."""
