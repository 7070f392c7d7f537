# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the node tests."""

import pytest


@pytest.fixture
def harness(ros):
    """Return a harness that runs nodes in the test's own process."""
    from support.ros_graph import NodeHarness

    made = NodeHarness()
    yield made
    made.close()
