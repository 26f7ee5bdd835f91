//! The whole state of an estimator or a monitor as bytes, and back.
//!
//! What is restored goes on bit for bit as what was kept. The bytes are of one version of this crate and say so.

use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::error::Error;

const VERSION: &str = env!("CARGO_PKG_VERSION");

/// All of it as bytes.
///
/// # Errors
/// It holds a law that is no data: one of somebody else's making.
pub fn keep(state: &impl Serialize) -> Result<Vec<u8>, Error> {
    postcard::to_stdvec(&(VERSION, state)).map_err(|error| Error(format!("snapshot: {error}")))
}

/// What [`keep`] has made.
///
/// # Errors
/// The bytes are of another version, or no snapshot.
pub fn restore<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, Error> {
    let wrong = |found: String| Error(format!("snapshot: expected one of version {VERSION}, got {found}"));
    let (version, rest) =
        postcard::take_from_bytes::<&str>(bytes).map_err(|error| wrong(error.to_string()))?;
    if version != VERSION {
        return Err(wrong(format!("version {version}")));
    }
    match postcard::take_from_bytes(rest) {
        Ok((state, [])) => Ok(state),
        Ok(_) => Err(wrong("more than a snapshot".into())),
        Err(error) => Err(wrong(error.to_string())),
    }
}

/// Arrays of any length, which serde has up to 32.
pub(crate) mod array {
    use super::{Deserialize, Deserializer, Serialize, Serializer, fitting};

    pub fn serialize<S: Serializer, const N: usize>(values: &[f64; N], to: S) -> Result<S::Ok, S::Error> {
        values.as_slice().serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>, const N: usize>(from: D) -> Result<[f64; N], D::Error> {
        let values = Vec::deserialize(from)?;
        values.try_into().map_err(fitting::<D>)
    }
}

/// Arrays of arrays, row by row.
pub(crate) mod rows {
    use super::{Deserialize, Deserializer, Serialize, Serializer, fitting};

    pub fn serialize<S: Serializer, const N: usize, const M: usize>(
        values: &[[f64; N]; M],
        to: S,
    ) -> Result<S::Ok, S::Error> {
        values.as_flattened().serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>, const N: usize, const M: usize>(
        from: D,
    ) -> Result<[[f64; N]; M], D::Error> {
        let values = Vec::<f64>::deserialize(from)?;
        let mut made = [[0.0; N]; M];
        if values.len() != N * M {
            return Err(fitting::<D>(values));
        }
        made.as_flattened_mut().copy_from_slice(&values);
        Ok(made)
    }
}

fn fitting<'de, D: Deserializer<'de>>(values: Vec<f64>) -> D::Error {
    D::Error::custom(format!("an array of {} numbers does not fit", values.len()))
}
