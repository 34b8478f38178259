"""Protobuf messages read by the FileDescriptorSet that a log carries, without generated code."""

from typing import Any

from google.protobuf.descriptor_database import DescriptorDatabase, DescriptorDatabaseConflictingDefinitionError
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass


class MessageTypes:
    """The message types of one FileDescriptorSet. Raises ValueError where the bytes are none."""

    def __init__(self, descriptor_set: bytes) -> None:
        files = DescriptorDatabase()  # asked by the pool, so that a file may come before those that it imports
        try:
            for file in FileDescriptorSet.FromString(descriptor_set).file:
                files.Add(file)
        except (DecodeError, DescriptorDatabaseConflictingDefinitionError) as error:
            raise ValueError(f"protobuf: the schema is not usable: {error}") from None
        self._pool = DescriptorPool(files)

    def read(self, type_name: str, data: bytes) -> Any:
        """A message with the fields of its type, those not written at their defaults.

        Raises ValueError where it does not decode.
        """
        try:
            return GetMessageClass(self._pool.FindMessageTypeByName(type_name)).FromString(data)
        except KeyError:
            raise ValueError(f"the schema does not define {type_name}") from None
        except (DecodeError, TypeError) as error:
            raise ValueError(f"protobuf: {error}") from None
