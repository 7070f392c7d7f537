# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What other readers see of a bag."""

import yaml


def metadata_of(folder):
    """Return the contents of ``metadata.yaml`` below its root key."""
    text = (folder / 'metadata.yaml').read_text(encoding='utf-8')
    return yaml.safe_load(text)['rosbag2_bagfile_information']


def topics_of(folder):
    """Return the topics of ``metadata.yaml``: name, type hash, offered profiles and count."""
    return [
        (
            topic['topic_metadata']['name'],
            topic['topic_metadata']['type_description_hash'],
            topic['topic_metadata']['offered_qos_profiles'],
            topic['message_count'],
        )
        for topic in metadata_of(folder)['topics_with_message_count']
    ]
