//! Print a joint's estimates, those missing counted: `cargo run -- elbow [tcp/127.0.0.1:7447 [COUNT]]`.

use std::io::{self, Write};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use drivelink_wire::Estimate;
use zenoh::config::EndPoint;
use zenoh::handlers::RingChannel;
use zenoh::{Config, Wait};

/// Connect as a client; what goes wrong is one line.
fn session(endpoint: &str) -> Result<zenoh::Session, String> {
    let wrong = |_| format!("ENDPOINT: expected one like tcp/127.0.0.1:7447, got {endpoint}");
    let endpoint: EndPoint = endpoint.parse().map_err(wrong)?;
    let mut config = Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_string()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_string()),
    ] {
        config.insert_json5(key, &value).map_err(|error| format!("{key}: {error}"))?;
    }
    let expected = "expected a daemon (drivelink run) or a zenoh router";
    zenoh::open(config).wait().map_err(|_| format!("{endpoint}: nobody answers there: {expected}"))
}

fn main() -> ExitCode {
    let Err(why) = run() else {
        return ExitCode::SUCCESS;
    };
    eprintln!("{why}");
    ExitCode::FAILURE
}

/// One line of an estimate, with two digits of the uncertainty and the value as far.
fn print(estimate: &Estimate, missing: u64) -> io::Result<()> {
    let now_ns = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as i128;
    let places = (1.0 - estimate.stiffness_std_nm_rad.log10().floor()).clamp(0.0, 9.0) as usize;
    writeln!(
        io::stdout(),
        "{} {:.3} N·m, {:.places$} ± {:.places$} N·m/rad, valid {}, observable {}, usable {}, {} µs after its SYNC, {} missing",
        estimate.sequence,
        estimate.flexibility_torque_nm,
        estimate.stiffness_nm_rad,
        estimate.stiffness_std_nm_rad,
        estimate.valid(),
        estimate.observable(),
        estimate.usable(),
        (now_ns - i128::from(estimate.stamp_ns)) / 1000,
        missing
    )
}

fn run() -> Result<(), String> {
    let mut arguments = std::env::args().skip(1);
    let joint = arguments.next().unwrap_or("elbow".into());
    let endpoint = arguments.next().unwrap_or("tcp/127.0.0.1:7447".into());
    let number =
        |n: String| n.parse::<usize>().map_err(|_| format!("COUNT: expected a whole number, got {n}"));
    let count = arguments.next().map_or(Ok(usize::MAX), number)?;

    let session = session(&endpoint)?;
    let subscriber = session
        .declare_subscriber(format!("drivelink/{joint}/estimate"))
        .with(RingChannel::new(1024))
        .wait()
        .map_err(|_| format!("JOINT: expected the name of a joint, got {joint:?}"))?;

    let mut last: Option<u64> = None;
    let mut missing = 0;
    for _ in 0..count {
        let sample = loop {
            match subscriber.recv_timeout(Duration::from_secs(3)) {
                Ok(Some(sample)) => break sample,
                Err(error) => return Err(format!("{endpoint}: {error}")),
                Ok(None) => {
                    eprintln!("no estimate of {joint} at {endpoint}: `drivelink list` names the joints")
                }
            }
        };
        let decoded = Estimate::decode(sample.payload()).inspect_err(|error| eprintln!("not used: {error}"));
        let Ok(estimate) = decoded else { continue };
        missing += last.map_or(0, |last| estimate.sequence.saturating_sub(last + 1));
        last = Some(estimate.sequence);
        match print(&estimate, missing) {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => break, // `| head`
            Err(error) => return Err(format!("standard output: {error}")),
            Ok(()) => (),
        }
    }
    Ok(())
}
