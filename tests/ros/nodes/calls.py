"""Writes a bag of a service's recorded calls, as service introspection does: calls.py FOLDER."""

import sys

from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from service_msgs.msg import ServiceEventInfo
from std_srvs.srv import Trigger

with Writer(sys.argv[1], version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    connection = writer.add_connection(
        "/plan/_service_event", "std_srvs/srv/Trigger_Event", msgdef="#", rihs01="RIHS01_unknown"
    )
    for i in range(4):
        for kind in (ServiceEventInfo.REQUEST_SENT, ServiceEventInfo.REQUEST_RECEIVED, ServiceEventInfo.RESPONSE_SENT):
            event = Trigger.Event()
            event.info.event_type, event.info.sequence_number = kind, i
            if kind == ServiceEventInfo.RESPONSE_SENT:
                event.response = [Trigger.Response(success=True)]
            else:
                event.request = [Trigger.Request()]
            writer.write(connection, 10**9 + i, serialize_message(event))
