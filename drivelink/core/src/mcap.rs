//! The records of an MCAP file (mcap.dev/spec): where its channels and messages are.

/// One record of some, by the place of its parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Record<'a> {
    /// A channel: its number and topic.
    Channel(u16, &'a [u8]),
    /// A message: its channel, its time in ns, its data.
    Message(u16, u64, &'a [u8]),
    /// Another one.
    Other,
}

const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const HEAD: usize = 9; // opcode, length
const MESSAGE_HEAD: usize = 22; // channel, sequence, log time, publish time
const CHANNEL_HEAD: usize = 8; // channel, schema, length of the topic

/// Split the first record off; `None`: it is damaged.
#[must_use]
pub fn split(data: &[u8]) -> Option<(Record<'_>, &[u8])> {
    let (opcode, length) = (*data.first()?, u64::from_le_bytes(bytes(data, 1)?));
    let rest = &data[HEAD..];
    let (body, rest) = rest.split_at_checked(usize::try_from(length).ok()?)?;
    let record = match opcode {
        0 => return None,
        CHANNEL => {
            let length = u32::from_le_bytes(bytes(body, 4)?) as usize;
            let topic = &body[CHANNEL_HEAD..];
            Record::Channel(u16::from_le_bytes(bytes(body, 0)?), &topic[..length.min(topic.len())])
        }
        MESSAGE => {
            let time = u64::from_le_bytes(bytes(body, 6)?);
            Record::Message(u16::from_le_bytes(bytes(body, 0)?), time, body.get(MESSAGE_HEAD..)?)
        }
        _ => Record::Other,
    };
    Some((record, rest))
}

fn bytes<const N: usize>(data: &[u8], at: usize) -> Option<[u8; N]> {
    data.get(at..at + N)?.try_into().ok()
}
