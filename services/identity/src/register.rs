//! Who is known, in memory: carried forward from the rows, changed by decisions of core, told to the ports.
//!
//! Invariants:
//! 1. A decision is told to the ports of this process before its answer leaves; other processes hear of it with the store's wake.
//! 2. A row that goes is gone here too, whichever process took it away.

use midshift_core::audit::Note;
use midshift_core::identity::{
    Actor, Directory, RobotIdentity, RootCertificate, ServerCertificate, TokenId, TokenName, TokenRecord,
};
use midshift_core::ids::RobotId;
use midshift_core::item::{Expect, Item};
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{BadRow, Record, Revision, Table, Writer};
use midshift_core::time::Clock;
use midshift_store::{Change, CommitError, Error, Fold, Projection, Store};
use std::collections::BTreeMap;
use std::sync::Arc;
use tokio::sync::{Mutex, watch};

/// Decisions that were overtaken are taken again so often.
const TRIES: usize = 8;

/// The rows as maps.
#[derive(Debug, Default)]
pub struct View {
    /// Tokens by their id.
    pub tokens: BTreeMap<TokenId, (TokenRecord, Revision)>,
    /// The newest token of each name.
    pub names: BTreeMap<String, (TokenName, Revision)>,
    /// Identities of robots, by the robot's id.
    pub robots: BTreeMap<RobotId, (RobotIdentity, Revision)>,
    /// Certificates of servers, by the digest of the key.
    pub servers: BTreeMap<String, (ServerCertificate, Revision)>,
    /// The root.
    pub authority: Option<(RootCertificate, Revision)>,
}

impl Fold for View {
    fn tables() -> &'static [Table] {
        &[Table::Token, Table::TokenName, Table::RobotIdentity, Table::ServerCertificate, Table::RootCertificate]
    }
    fn reset(&mut self) {
        *self = Self::default();
    }
    /// A token or a certificate of a server that only a newer version can read is not known here: it lets nobody in, and
    /// the others are followed. A robot's row must be read: it says which keys are denied.
    fn apply(&mut self, change: Change) -> Result<(), BadRow> {
        let revision = change.revision;
        match change.key.table {
            Table::Token => match known::<TokenRecord>(&change) {
                Some(token) => drop(self.tokens.insert(token.token_id.clone(), (token, revision))),
                None => drop(TokenId::new(&change.key.id).and_then(|id| self.tokens.remove(&id))),
            },
            Table::TokenName => match known::<TokenName>(&change) {
                Some(name) => drop(self.names.insert(name.id(), (name, revision))),
                None => drop(self.names.remove(&*change.key.id)),
            },
            Table::RobotIdentity => match change.decode::<RobotIdentity>()? {
                Some(robot) => drop(self.robots.insert(robot.robot_id.clone(), (robot, revision))),
                None => drop(RobotId::parse(&change.key.id).ok().and_then(|id| self.robots.remove(&id))),
            },
            Table::ServerCertificate => match known::<ServerCertificate>(&change) {
                Some(server) => drop(self.servers.insert(server.id(), (server, revision))),
                None => drop(self.servers.remove(&*change.key.id)),
            },
            Table::RootCertificate => {
                self.authority = change.decode::<RootCertificate>()?.map(|authority| (authority, revision))
            }
            _ => {}
        }
        Ok(())
    }
}

/// The row; none if it is gone or cannot be read here.
fn known<R: Record>(change: &Change) -> Option<R> {
    change.decode().unwrap_or_else(|error| {
        tracing::warn!(%error, "a row of identity cannot be read, and lets nobody in");
        None
    })
}

/// What a decision comes to: what is written, if anything, and what is answered.
pub type Decision<T> = (Option<Item>, T);

/// The rows, and who is told of them.
pub struct Register {
    store: Arc<dyn Store>,
    clock: Arc<dyn Clock>,
    rows: Mutex<Projection<View>>,
    directory: watch::Sender<Arc<Directory>>,
}

impl Register {
    /// Nothing is read yet.
    pub fn new(store: Arc<dyn Store>, clock: Arc<dyn Clock>) -> Self {
        Self {
            store,
            clock,
            rows: Mutex::new(Projection::new(View::default())),
            directory: watch::Sender::new(Arc::default()),
        }
    }

    /// What ports may know.
    pub fn directory(&self) -> watch::Receiver<Arc<Directory>> {
        self.directory.subscribe()
    }

    /// Comes up to the store's head and tells the ports.
    ///
    /// # Errors
    /// The store does not answer.
    pub async fn refresh(&self) -> Result<(), Error> {
        let mut rows = self.rows.lock().await;
        rows.advance(&*self.store).await?;
        let view = rows.fold();
        let (tokens, robots) = (view.tokens.values().map(|(t, _)| t), view.robots.values().map(|(r, _)| r));
        let directory = Directory::from_rows(tokens, robots, self.clock.now().steady_wall());
        self.directory.send_if_modified(|known| {
            let differs = **known != directory;
            if differs {
                *known = Arc::new(directory);
            }
            differs
        });
        Ok(())
    }

    /// Looks at the rows as they are now.
    ///
    /// # Errors
    /// The store does not answer.
    pub async fn ask<T>(&self, look: impl FnOnce(&View) -> T) -> Result<T, Error> {
        self.refresh().await?;
        Ok(look(self.rows.lock().await.fold()))
    }

    /// Decides, writes, and tells the ports. What another decision has overtaken is decided again.
    ///
    /// # Errors
    /// As decided; the store does not answer; nobody knows whether it was written.
    pub async fn decide<T>(&self, mut decide: impl FnMut(&View) -> Result<Decision<T>, Refusal>) -> Result<T, Refusal> {
        for _ in 0..TRIES {
            let (item, answer) = self.ask(&mut decide).await.map_err(unavailable)??;
            let Some(item) = item else { return Ok(answer) };
            match self.store.commit(vec![item]).await.remove(0) {
                Ok(_) => {
                    if let Err(error) = self.refresh().await {
                        tracing::warn!(%error, "a decision is written and this port does not know it yet");
                    }
                    return Ok(answer);
                }
                Err(CommitError::Conflict { .. }) => {}
                Err(error @ CommitError::Unavailable(_)) => return Err(unavailable(error)),
                Err(error @ CommitError::Unknown(_)) => {
                    tracing::warn!(%error, "nobody knows whether a decision was written");
                    return Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown));
                }
                Err(error) => {
                    tracing::error!(%error, "a decision cannot be written");
                    return Err(Refusal::new(Kind::Internal, Code::Internal));
                }
            }
        }
        Err(Refusal::new(Kind::Conflict, Code::MovedMeanwhile))
    }

    /// As [`Register::decide`], of somebody's decision: what is refused as things are stands in the audit too, by `note`. Whoever asked hears why, whether or
    /// not that can be written down.
    ///
    /// # Errors
    /// The same.
    pub async fn decide_for<T>(
        &self,
        actor: impl Into<Actor>,
        note: Note,
        decide: impl FnMut(&View) -> Result<Decision<T>, Refusal>,
    ) -> Result<T, Refusal> {
        let decided = self.decide(decide).await;
        if let Err(refusal) = &decided {
            let item = Item::for_refusal(Writer::Identity, actor, None, note, refusal);
            drop(self.store.commit(item.into_iter().collect()).await);
        }
        decided
    }
}

/// An item that writes one record: new, or over the one that was looked at.
pub fn written<R: Record>(record: &R, at: Option<Revision>, actor: impl Into<Actor>, kind: &'static str) -> Item {
    let mut item = Item::new(Writer::Identity, actor);
    item.put_row(record, at.map_or(Expect::Absent, Expect::At), kind);
    item
}

/// The same as somebody's decision, with what it leaves in the audit.
pub fn decided<R: Record>(
    record: &R,
    at: Option<Revision>,
    actor: impl Into<Actor>,
    kind: &'static str,
    note: Note,
) -> Item {
    let mut item = written(record, at, actor, kind);
    item.audit(note);
    item
}

fn unavailable(error: impl std::error::Error) -> Refusal {
    tracing::warn!(%error, "the store does not answer");
    Refusal::new(Kind::Unavailable, Code::StoreUnavailable)
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::identity::{Act, Deny, Digest};
    use midshift_core::ids::SiteId;
    use midshift_core::item::Write;
    use midshift_core::rows::Key;
    use midshift_core::time::{ScaledClock, Utc};
    use midshift_store::{MemoryStore, SqliteStore, StoreId};

    const NOW: Utc = Utc(1_800_000_000_000);

    fn token(id: &str) -> TokenRecord {
        TokenRecord {
            token_id: TokenId::new(id).expect("an id"),
            name: id.to_owned(),
            person: None,
            digest: Digest([7; 32]),
            grants: Vec::new(),
            created_unix_ms: NOW.0,
            created_by: "anna".to_owned(),
            expires_unix_ms: NOW.0 + 1_000,
            revoked: None,
            rotation: None,
        }
    }

    fn robot(id: &str) -> RobotIdentity {
        let deny = Deny { key: Digest([9; 32]), until_unix_ms: NOW.0 + 1_000 };
        let robot = RobotIdentity::new(RobotId::parse(id).expect("an id"));
        RobotIdentity { denied: vec![deny], revoked: Some(Act::new("anna", NOW.0)), ..robot }
    }

    #[tokio::test]
    async fn a_token_that_only_a_newer_version_can_read_lets_nobody_in_and_the_others_are_followed() {
        let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(|| 0, NOW, 1000));
        let site = SiteId::parse("factory").expect("an id");
        let store: Arc<dyn Store> = Arc::new(MemoryStore::new(site, StoreId(Arc::from("s")), clock.clone()));
        let register = Register::new(store.clone(), clock);
        let directory = register.directory();
        let mut item = Item::new(Writer::Identity, "elsewhere");
        item.create(&token("t1"), "made").create(&token("t2"), "made");
        let Write::Put { body, .. } = &mut item.rows[0].write else { panic!("a row is put") };
        *body = body.replace("\"name\"", "\"names\"").into();
        store.commit(vec![item]).await.remove(0).expect("applied");
        register.refresh().await.expect("rows");
        let ids = || directory.borrow().tokens.keys().map(|id| id.as_str().to_owned()).collect::<Vec<_>>();
        assert_eq!(ids(), ["t2"]);
        let mut item = Item::new(Writer::Identity, "elsewhere");
        item.delete(Key::new(Table::Token, "t2"), Revision(1), "gone");
        store.commit(vec![item]).await.remove(0).expect("applied");
        register.refresh().await.expect("rows");
        assert_eq!(ids(), [] as [&str; 0], "what comes after it is followed");
    }

    #[tokio::test]
    async fn rows_that_another_process_took_away_are_gone_here_and_at_the_ports() {
        let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(|| 0, NOW, 1000));
        let dir = tempfile::tempdir().expect("a folder");
        let site = SiteId::parse("factory").expect("an id");
        let store = SqliteStore::open(dir.path(), site, clock.clone()).await.expect("a new store");
        let store: Arc<dyn Store> = Arc::new(store);
        let mut item = Item::new(Writer::Identity, "elsewhere");
        item.create(&token("t1"), "made").create(&token("t2"), "made");
        item.create(&robot("r1"), "made").create(&robot("r2"), "made");
        store.commit(vec![item]).await.remove(0).expect("applied");
        let register = Register::new(store.clone(), clock);
        let directory = register.directory();
        let known = async || register.ask(|view| (view.tokens.len(), view.robots.len())).await.expect("rows");
        assert_eq!(known().await, (2, 2));
        assert_eq!(directory.borrow().tokens.len(), 2);
        let mut item = Item::new(Writer::Identity, "elsewhere");
        for (table, id) in [(Table::Token, "t1"), (Table::RobotIdentity, "r1"), (Table::RobotIdentity, "r2")] {
            item.delete(Key::new(table, id), Revision(1), "gone");
        }
        store.commit(vec![item]).await.remove(0).expect("applied");
        assert_eq!(known().await, (1, 0));
        let directory = directory.borrow();
        assert_eq!((directory.tokens.len(), directory.denied.len()), (1, 0));
    }
}
