//! `midshift explain-error`: what a reason means and what to try.

use super::client::Exit;
use super::out::{Format, Out};
use midshift_core::reason::Code;

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
