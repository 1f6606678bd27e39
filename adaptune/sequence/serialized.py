"""Numbers and texts of serialised ROS messages, where a whole message would take too long."""

import struct

_WORD = {order: struct.Struct(f"{order}I").unpack_from for order in "<>"}


class Serialized:
    """Reads a message, as it lies in the bag, from its beginning.

    `cdr` says whether it is serialised as in ROS 2: in either byte order, and with aligned numbers.
    All methods raise ValueError, IndexError or struct.error where the message is not long enough.
    """

    def __init__(self, data: bytes | memoryview, cdr: bool):
        if cdr and bytes(data[:2]) not in (b"\0\0", b"\0\1"):
            raise ValueError("not in CDR")
        self.order = "<" if not cdr or data[1] else ">"  # of bytes, as numpy and struct write it
        self.data = memoryview(data)[4 if cdr else 0 :]
        self.at = 0  # where to read on
        self._cdr = cdr
        self._unpack = _WORD[self.order]

    def align(self, size: int) -> None:
        """Pass over the padding before a number of this size."""
        if self._cdr:
            self.at = -(-self.at // size) * size

    def uint32(self) -> int:
        """Read a number of four bytes."""
        self.align(4)
        (number,) = self._unpack(self.data, self.at)
        self.at += 4
        return int(number)

    def uint8(self) -> int:
        """Read a number of one byte."""
        number = self.data[self.at]
        self.at += 1
        return number

    def block(self, size: int) -> memoryview:
        """Read so many bytes."""
        begin, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise ValueError(f"{size} bytes are declared, there are {len(self.data) - begin}")
        return self.data[begin : self.at]

    def text(self) -> str:
        """Read a text; in ROS 2 it ends with a zero."""
        return bytes(self.block(self.uint32())).rstrip(b"\0").decode()

    def header(self) -> int:
        """Read a std_msgs/Header, and give its stamp in nanoseconds."""
        if not self._cdr:
            self.uint32()  # its sequence number
        stamp = self.uint32() * 10**9 + self.uint32()
        self.text()
        return stamp

    def end(self) -> None:
        """Make sure that nothing is left but padding."""
        left = len(self.data) - self.at
        if left > (3 if self._cdr else 0):
            raise ValueError(f"{left} bytes are left over")


def header_stamp(data: bytes | memoryview, cdr: bool) -> int | None:
    """Stamp of a message that begins with a header; none if it is damaged there."""
    try:
        return Serialized(data, cdr).header()
    except (ValueError, IndexError, struct.error):
        return None
