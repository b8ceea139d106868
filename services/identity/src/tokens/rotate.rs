//! Replaces a token by another one of its name, in one decision.
//!
//! Invariant: the new one has the rights and the person of the old one, never more. There is no moment at which neither of them is good.

use super::{check_name, check_valid, digest, draw, made, note, standing, taken};
use crate::register::{Register, View};
use midshift_core::audit::Note;
use midshift_core::identity::{Act, Actor, Rotation, Secret, TokenRecord};
use midshift_core::ids::RequestId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal, Violations};
use midshift_core::rows::Revision;
use midshift_core::time::{LinkDuration, Utc};
use midshift_proto::identity::v1;

/// A token that is to be replaced.
#[derive(Clone, Debug)]
pub struct Turn {
    name: String,
    /// None: as long as the old one was made for.
    valid: Option<LinkDuration>,
    overlap: LinkDuration,
    request_id: Option<RequestId>,
}

impl Turn {
    /// Checks what was asked for.
    ///
    /// # Errors
    /// Each broken rule.
    pub fn check(r: &v1::RotateTokenRequest) -> Result<Self, Refusal> {
        let mut bad = Violations::default();
        check_name("name", &r.name, &mut bad);
        let valid = (r.valid_seconds > 0).then(|| check_valid(r.valid_seconds, &mut bad));
        let longest = limits::TOKEN_OVERLAP_MAX.as_ms() / 1000;
        if r.overlap_seconds > longest {
            bad.add("overlap_seconds", format!("must be at most {longest}: 7 days"));
        }
        let named = !r.request_id.is_empty();
        let request_id = named.then(|| bad.accept("request_id", RequestId::parse(&r.request_id))).flatten();
        bad.finish()?;
        Ok(Self { name: r.name.clone(), valid, overlap: LinkDuration::from_secs(r.overlap_seconds), request_id })
    }

    /// What it asks for, as text that differs where the request does.
    fn asked(&self) -> String {
        let valid_ms = self.valid.map_or(0, LinkDuration::as_ms);
        format!("{} {valid_ms} {}", self.name, self.overlap.as_ms())
    }

    /// The token that the same request made before.
    fn done_before<'v>(&self, view: &'v View) -> Result<Option<&'v TokenRecord>, Refusal> {
        let Some(request_id) = &self.request_id else { return Ok(None) };
        let made = view.tokens.values().find_map(|(token, _)| {
            let rotation = token.rotation.as_ref()?;
            (rotation.request_id == request_id.as_str()).then_some((token, rotation))
        });
        match made {
            Some((_, rotation)) if rotation.asked != self.asked() => {
                let reason = Reason::from(Code::RequestIdReused).with("request_id", request_id);
                Err(Refusal::new(Kind::AlreadyExists, reason))
            }
            made => Ok(made.map(|(token, _)| token)),
        }
    }

    /// The token that it replaces: the one of its name that stands and was not replaced yet.
    fn old<'v>(&self, view: &'v View, now: Utc) -> Result<&'v (TokenRecord, Revision), Refusal> {
        let mut known = standing(view, &self.name, now).filter(|(token, _)| token.revoked.is_none());
        match (known.next(), known.next()) {
            (Some(old), None) => Ok(old),
            (Some(_), Some(_)) => Err(taken(&self.name, Kind::Precondition)),
            (None, _) => {
                let text = "no token of this name stands: make one, or list them";
                let reason = Reason::new(Code::TokenNotFound, text).with("name", &self.name);
                Err(Refusal::new(Kind::NotFound, reason))
            }
        }
    }

    fn successor(&self, old: &TokenRecord, secret: &Secret, by: &Actor, now: Utc) -> TokenRecord {
        let lived = old.expires_unix_ms.abs_diff(old.created_unix_ms);
        let valid_ms = self.valid.map_or(lived, LinkDuration::as_ms);
        let request_id = self.request_id.as_ref().map(ToString::to_string).unwrap_or_default();
        TokenRecord {
            token_id: secret.id().clone(),
            digest: digest(secret),
            created_unix_ms: now.0,
            created_by: by.to_string(),
            expires_unix_ms: now.0.saturating_add_unsigned(valid_ms),
            rotation: Some(Rotation { of: old.token_id.clone(), request_id, asked: self.asked() }),
            ..old.clone()
        }
    }
}

/// Replaces a token. The secret is there once: not where the same request was carried out before.
///
/// # Errors
/// No token of the name stands, or several do; the request_id asked for something else; the store.
pub async fn rotate(
    register: &Register,
    turn: &Turn,
    by: &Actor,
    now: Utc,
) -> Result<(TokenRecord, Option<Secret>), Refusal> {
    let secret = draw();
    let asked = Note::new("token.rotate").with("name", &turn.name);
    let decided = register.decide_for(by, asked, |view| {
        if let Some(token) = turn.done_before(view)? {
            return Ok((None, (token.clone(), false)));
        }
        let (old, at) = turn.old(view, now)?;
        let new = turn.successor(old, &secret, by, now);
        let note = note("token.rotate", &new).about("token", &old.token_id).with("overlap_ms", turn.overlap.as_ms());
        let mut item = made(view, &new, by, note);
        let ends = now.0.saturating_add_unsigned(turn.overlap.as_ms());
        let ended = TokenRecord { revoked: Some(Act::new(by.name(), ends)), ..old.clone() };
        item.update(&ended, *at, "token.rotated");
        item.request_id = turn.request_id.as_ref().map(|id| id.as_str().into());
        Ok((Some(item), (new, true)))
    });
    let (token, is_new) = decided.await?;
    Ok((token, is_new.then_some(secret)))
}
