# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What other readers see of a bag, and copies of bags with other messages."""

from collections import Counter
import functools
import io

from mcap.reader import make_reader
import yaml

from t3mpc_ros.bag.mcap_file import SerializedMessage
from t3mpc_ros.bag.recovery import recover_file
from t3mpc_ros.bag.writer import BagWriter


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


def kept_messages(path):
    """Return the messages that a recovery of a file finds."""
    output = io.BytesIO()
    with path.open('rb') as source:
        recover_file(source, output, path.name)
    output.seek(0)
    return messages_in(output)


def messages_of(path):
    """Return the messages of a complete file, as the mcap library reads them."""
    with path.open('rb') as file:
        return messages_in(file)


def messages_in(file):
    reader = make_reader(file, validate_crcs=True)
    return [
        SerializedMessage(channel.topic, item.log_time, item.publish_time, item.data)
        for _, channel, item in reader.iter_messages()
    ]


def copied_bag(bag, folder, change):
    """Return ``folder`` with a copy of a bag file.

    ``change(topic, k, received_ns, published_ns)`` yields (topic, received_ns, published_ns) of
    every copy of message k of a topic: none where it is left out.
    """
    counts, added = Counter(), set()
    records, messages = _content(bag, bag.stat().st_mtime_ns)
    with BagWriter(folder, metadata_records=records) as writer:
        for original, kind, received_ns, published_ns, data in messages:
            k, counts[original] = counts[original], counts[original] + 1
            for topic, *times in change(original, k, received_ns, published_ns):
                if topic not in added:
                    writer.add_topic(topic, kind)
                    added.add(topic)
                writer.write(topic, *times, data)
    return folder


@functools.cache
def _content(bag, modified_ns):
    """Return metadata records and messages of a file, read once while it is not modified."""
    with bag.open('rb') as file:
        reader = make_reader(file)
        records = {item.name: dict(item.metadata) for item in reader.iter_metadata()}
        records.pop('rosbag2')
        messages = [
            (channel.topic, schema.name, item.log_time, item.publish_time, item.data)
            for schema, channel, item in reader.iter_messages()
        ]
    return records, messages
