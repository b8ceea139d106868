//! Reasons in words: of an explanation, and `midshift explain-error`: what a reason means and what to try.

use super::client::Exit;
use super::out::{Format, Out, plain};
use midshift_core::fleet::WAITS_FOR;
use midshift_core::reason::Code;
use midshift_proto::common::v1::Reason;

/// The lines of an explanation that say what is done or waited for; `nothing`: in case there is no reason.
pub fn verdict(reason: Option<&Reason>, nothing: &str) -> String {
    let Some(reason) = reason else { return format!("\n  {nothing}\n") };
    let told = format!("\n  {}: {}\n", reason.code, plain(&reason.message));
    match reason.metadata.get(WAITS_FOR).filter(|what| !what.is_empty()) {
        Some(what) => told + &format!("  waits for {}\n", plain(what)),
        None => told,
    }
}

/// One code, or all.
pub fn error(code: Option<&str>, out: &Out) -> Result<(), Exit> {
    let codes: Vec<Code> = match code {
        None => Code::ALL.to_vec(),
        Some(text) => {
            let name = text.to_uppercase().replace('-', "_");
            vec![
                name.parse()
                    .map_err(|()| Exit::new(4, format!("there is no reason {text}\n  try: midshift explain-error")))?,
            ]
        }
    };
    for code in codes {
        match out.format {
            Format::Table => out.line(&format!("{code}\n  {}", code.help())),
            Format::Name => out.line(code.as_str()),
            Format::Json | Format::Jsonl => {
                out.line(&serde_json::json!({"code": code.as_str(), "help": code.help()}).to_string())
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_explanation_names_what_is_waited_for_where_something_is() {
        let mut reason =
            Reason { code: "PLACE_OCCUPIED".into(), message: "waits for a place".into(), ..Reason::default() };
        assert_eq!(verdict(Some(&reason), "-"), "\n  PLACE_OCCUPIED: waits for a place\n");
        reason.metadata.insert(WAITS_FOR.into(), "door: held by r1".into());
        assert!(verdict(Some(&reason), "-").ends_with("\n  waits for door: held by r1\n"));
        assert_eq!(verdict(None, "nothing holds it"), "\n  nothing holds it\n");
    }
}
