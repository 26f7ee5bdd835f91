//! Messages of a recording: flat JSON objects, of which some fields are wanted.

/// The value of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// A number; `null` is NaN.
    Number(f64),
    /// The inside of a text, escapes as they are.
    Text(&'a [u8]),
    /// `true` or `false`.
    Flag,
}

/// Give each field to `take`, in order.
///
/// # Errors
/// What was expected: it is no JSON object, or one with others or lists in it.
pub fn each<'a>(data: &'a [u8], mut take: impl FnMut(&'a [u8], Value<'a>)) -> Result<(), &'static str> {
    const NOT: &str = "expected a JSON object";
    let mut rest = after(data, b'{').ok_or(NOT)?;
    let mut closed = after(rest, b'}');
    while closed.is_none() {
        let (name, behind) = text(after(rest, b'"').ok_or(NOT)?).ok_or(NOT)?;
        let behind = after(behind, b':').ok_or(NOT)?.trim_ascii_start();
        let (value, behind) = value(behind)?;
        take(name, value);
        closed = after(behind, b'}');
        if closed.is_none() {
            rest = after(behind, b',').ok_or(NOT)?;
        }
    }
    closed.is_some_and(|rest| rest.trim_ascii().is_empty()).then_some(()).ok_or(NOT)
}

fn value(data: &[u8]) -> Result<(Value<'_>, &[u8]), &'static str> {
    const NOT: &str = "expected a number, a text, true, false or null";
    const WORDS: [(&[u8], Value<'static>); 6] = [
        (b"null", Value::Number(f64::NAN)),
        (b"NaN", Value::Number(f64::NAN)),
        (b"Infinity", Value::Number(f64::INFINITY)),
        (b"-Infinity", Value::Number(f64::NEG_INFINITY)),
        (b"true", Value::Flag),
        (b"false", Value::Flag),
    ];
    match data.first() {
        Some(b'"') => text(&data[1..]).map(|(inside, rest)| (Value::Text(inside), rest)).ok_or(NOT),
        Some(b'{' | b'[') => Err("expected a JSON object without others or lists in it"),
        _ => {
            if let Some((word, value)) = WORDS.iter().find(|(word, _)| data.starts_with(word)) {
                return Ok((*value, &data[word.len()..]));
            }
            let end = data.iter().position(|b| !matches!(b, b'0'..=b'9' | b'-' | b'+' | b'.' | b'e' | b'E'));
            let (number, rest) = data.split_at(end.unwrap_or(data.len()));
            let number =
                std::str::from_utf8(number).ok().and_then(|number| number.parse().ok()).ok_or(NOT)?;
            Ok((Value::Number(number), rest))
        }
    }
}

/// What follows a byte, which space may precede.
fn after(data: &[u8], byte: u8) -> Option<&[u8]> {
    data.trim_ascii_start().strip_prefix(&[byte])
}

/// The inside of a text whose first quote is read already, and what follows it.
fn text(data: &[u8]) -> Option<(&[u8], &[u8])> {
    let mut escaped = false;
    let end = data.iter().position(|&byte| {
        let end = byte == b'"' && !escaped;
        escaped = byte == b'\\' && !escaped;
        end
    })?;
    Some((&data[..end], &data[end + 1..]))
}

/// Identifier and bytes of a message of `/can`.
///
/// # Errors
/// What was expected.
pub fn frame(data: &[u8]) -> Result<(u32, Vec<u8>), &'static str> {
    const NOT: &str = "expected an 11-bit identifier and at most 64 bytes";
    let (mut can_id, mut digits) = (None, None);
    each(data, |name, value| match (name, value) {
        (b"id", Value::Number(number)) => can_id = Some(number),
        (b"data", Value::Text(text)) => digits = Some(text),
        _ => {}
    })?;
    let can_id = can_id.filter(|id| id.fract() == 0.0 && (0.0..2048.0).contains(id)).ok_or(NOT)? as u32;
    let digits = digits.filter(|digits| digits.len() <= 128 && digits.len() % 2 == 0).ok_or(NOT)?;
    let digit = |byte: u8| char::from(byte).to_digit(16);
    let byte = |pair: &[u8]| Some((digit(pair[0])? << 4 | digit(pair[1])?) as u8);
    Ok((can_id, digits.chunks(2).map(byte).collect::<Option<_>>().ok_or(NOT)?))
}
