"""The loop that closes itself: recorded, traced, proposed, accepted, shown.

| step | module | process |
|---|---|---|
| what led to an event becomes a recording | `blackbox` | the black box, beside the daemon (`cli.blackbox`) |
| a recording is traced to what the model lacks | `diagnosing`, `finding` | one of idle priority each |
| the finding is published | `feed` | the daemon, which only reads the file |
| a person accepts the proposed joint file | `acceptance` | `drivelink accept`, `drivelink monitor --web` |

The folder of the black box is the queue between them: `folder` says what lies in it.
"""
