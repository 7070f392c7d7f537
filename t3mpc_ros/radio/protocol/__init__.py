# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wire protocol: frames, codec, framing, authentication, clock synchronisation."""
