"""The filtered relative state in other systems' formats: pure functions from a message to bytes or text.

One rule holds for all: only a state in TRACK with its covariance is *trusted*; whatever else (INIT, AMBIGUOUS,
COAST, LOST, a state without its numbers) never looks like one that may be flown on.

| format | module | a state that is not trusted |
|---|---|---|
| UDP, binary | ``udp`` | flag VALID clear; numbers NaN, in COAST given with the flag NUMBERS |
| UDP, JSON lines | ``udp`` | ``"valid": false``; numbers null, in COAST given |
| ROS 2, CDR over Zenoh | ``ros2`` | not sent: the formats have no place for validity, readers watch the stamp |
| NASA 42, text socket | ``fortytwo`` | the time alone: 42 propagates by itself |
| CCSDS OEM and AEM | ``ccsds`` | left out, and the segment ends: nobody may interpolate across it |
| CSV, Parquet | ``table`` | a row with ``valid`` false and its mode: a log, not a feed |

Silence says nothing: a reader of any feed must take a state older than it can bear for lost.
"""
