//! The objects of an unpacked container of a BLF file, in the layout that python-can's reader knows.

/// A frame, by its parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame<'a> {
    /// Its identifier of 11 bits.
    pub can_id: u32,
    /// Of its bytes those that the object has: zeros that end them may be left out.
    pub data: &'a [u8],
    /// How many bytes it has.
    pub length: usize,
    /// Its channel, from 1 on.
    pub channel: u16,
}

/// What is at the begin of some bytes.
#[derive(Debug, PartialEq)]
pub enum Next<'a> {
    /// An object: the bytes up to its end, its stamp in ns, and the data frame that it is.
    Object(usize, u128, Option<Frame<'a>>),
    /// Not all of an object: it may go on in the next container.
    Part,
    /// Something else.
    Damaged(String),
}

const HEAD: usize = 32;
const TEN_US: u32 = 1; // unit of a stamp; else 1 ns
const EXTENDED: u32 = 0x8000_0000;

/// Look at the first object, which up to four bytes of padding may precede.
#[must_use]
pub fn next(data: &[u8]) -> Next<'_> {
    let Some(first) = data.get(..8) else { return Next::Part };
    let Some(begin) = first.windows(4).position(|bytes| bytes == b"LOBJ") else {
        return Next::Damaged("expected an object, got something else".into());
    };
    let data = &data[begin..];
    let (Some(version), Some(size), Some(kind)) =
        (number(data, 6, 2), number(data, 8, 4), number(data, 12, 4))
    else {
        return Next::Part;
    };
    let (Some(unit), Some(stamp)) = (number(data, 16, 4), number(data, 24, 8)) else { return Next::Part };
    let size = size as usize;
    if size < HEAD {
        return Next::Damaged(format!("expected no object of {size} bytes"));
    }
    let Some(object) = data.get(..size) else { return Next::Part };
    let body = if version == 1 { HEAD } else { HEAD + 8 };
    let Some(found) = frame(kind, object, body) else {
        return Next::Damaged("an object ends before its frame".into());
    };
    let unit = if unit == u64::from(TEN_US) { 10_000 } else { 1 };
    Next::Object(begin + size, u128::from(stamp) * unit, found)
}

/// The frame of an object; `None` in it: it has none, or a remote or long one; `None`: it is damaged.
fn frame(kind: u64, object: &[u8], at: usize) -> Option<Option<Frame<'_>>> {
    let of = |offset: usize, bytes: usize| number(object, at + offset, bytes);
    let (channel, length, can_id, remote, begin, end) = match kind {
        1 | 86 => (of(0, 2)?, of(3, 1)?.min(8), of(4, 4)?, of(2, 1)? & 0x80, at + 8, at + 16),
        100 => (of(0, 2)?, of(14, 1)?.min(64), of(4, 4)?, of(2, 1)? & 0x80, at + 20, at + 84),
        101 => {
            let further = of(35, 1)? as usize; // place of what follows the data; 0: nothing
            let end = if further > 0 { further.min(object.len()) } else { object.len() };
            (of(0, 1)?, of(2, 1)?, of(4, 4)?, of(12, 4)? & 0x10, at + 40, end)
        }
        _ => return Some(None),
    };
    let (can_id, length) = (can_id as u32, length as usize);
    let data =
        if kind == 101 { object.get(begin..end).unwrap_or_default() } else { object.get(begin..end)? };
    let plain = remote == 0 && can_id & EXTENDED == 0;
    Some(plain.then(|| Frame {
        can_id: can_id & 0x1FFF_FFFF,
        data: &data[..length.min(data.len())],
        length,
        channel: channel as u16,
    }))
}

fn number(data: &[u8], at: usize, bytes: usize) -> Option<u64> {
    let part = data.get(at..at + bytes)?;
    Some(part.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(kind: u32, size: u32, body: &[u8]) -> Vec<u8> {
        let mut data = [b"LOBJ".as_slice(), &[32, 0, 1, 0]].concat();
        for value in [size, kind, TEN_US, 0] {
            data.extend(value.to_le_bytes());
        }
        data.extend(7u64.to_le_bytes());
        data.extend(body);
        data
    }

    #[test]
    fn an_object_is_read_whole_left_for_later_or_refused() {
        let classic = [2, 0, 0, 3, 0x81, 1, 0, 0, 1, 2, 3, 0, 0, 0, 0, 0];
        let whole = [&[0, 0][..], &object(86, 48, &classic)].concat();
        let found = Frame { can_id: 0x181, data: &[1, 2, 3], length: 3, channel: 2 };
        assert_eq!(next(&whole), Next::Object(50, 70_000, Some(found)));
        (0..50).for_each(|cut| assert_eq!(next(&whole[..cut]), Next::Part));
        for remote in [[2, 0, 0x80, 0, 1, 0, 0, 0], [2, 0, 0, 0, 1, 0, 0, 0x80]] {
            let body = [&remote[..], &[0; 8]].concat();
            assert_eq!(next(&object(1, 48, &body)), Next::Object(48, 70_000, None));
        }
        assert_eq!(next(&object(99, 32, &[])), Next::Object(32, 70_000, None));
        let damaged = |data: &[u8]| matches!(next(data), Next::Damaged(_));
        assert!(damaged(&object(86, 0, &classic)) && damaged(&object(86, 40, &classic)) && damaged(&[0; 8]));
    }

    #[test]
    fn data_of_a_long_frame_ends_where_the_object_says() {
        let mut body = [0u8; 48];
        (body[0], body[2], body[4]) = (1, 12, 5);
        body[40..48].fill(9);
        let of = |body: &[u8]| {
            let data = object(101, 80, body);
            match next(&data) {
                Next::Object(80, _, Some(frame)) => (frame.data.to_vec(), frame.length),
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(of(&body), (vec![9; 8], 12));
        body[35] = 32 + 40 + 2;
        assert_eq!(of(&body), (vec![9; 2], 12));
        body[35] = 1;
        assert_eq!(of(&body), (vec![], 12));
    }
}
