//! The task types of the site: read, put, deleted.
//!
//! Invariant: they are read anew once anything was committed since. So a change holds for whatever is submitted after its
//! answer; another process of the service hears of it as soon as of any other commit.

use crate::TaskService;
use crate::admit::no_result;
use crate::commands::internal;
use crate::known_types::KnownTypes;
use crate::rows::unavailable;
use midshift_core::identity::{Caller, Permission};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal, Violations};
use midshift_core::rows::{Revision, Seq, Table, Writer};
use midshift_core::task::types::definition::TypeRules;
use midshift_core::task::types::{TypeCatalogue, TypeCommand};
use midshift_proto::convert::At;
use midshift_proto::convert::task::revision_of;
use midshift_proto::convert::task_type::{encode_catalogue, encode_rules, encode_task_type, parse_task_type};
use midshift_proto::task::v1;
use midshift_store::{CommitError, Query};
use std::sync::{Arc, MutexGuard, PoisonError};

/// Times that a change is decided anew because its row moved meanwhile, before the caller is told.
const TRIES: usize = 4;

impl TaskService {
    /// The task types of the site as they are now.
    pub(crate) async fn types(&self) -> Result<Arc<TypeCatalogue>, Refusal> {
        let head = *self.store().wake().borrow();
        if let Some(types) = self.kept_types().as_ref().filter(|known| known.head == head) {
            return Ok(types.types.clone());
        }
        self.read_types(head).await
    }

    /// As [`Self::types`], whatever this process knows already: another one may have changed them a moment ago.
    pub(crate) async fn newest_types(&self) -> Result<Arc<TypeCatalogue>, Refusal> {
        let head = *self.store().wake().borrow();
        self.read_types(head).await
    }

    async fn read_types(&self, head: Seq) -> Result<Arc<TypeCatalogue>, Refusal> {
        let query = Query { limit: limits::PAGE_MAX, ..Query::all(Table::TaskType) };
        let rows = self.store().list(query).await.map_err(unavailable)?;
        let types = Arc::new(TypeCatalogue::from_rows(&rows).map_err(unavailable)?);
        *self.kept_types() = Some(KnownTypes { head, types: types.clone() });
        Ok(types)
    }

    fn kept_types(&self) -> MutexGuard<'_, Option<KnownTypes>> {
        self.inner.types.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) async fn list_types(&self) -> Result<v1::ListTaskTypesResponse, Refusal> {
        Ok(encode_catalogue(self.types().await?.as_ref()))
    }

    pub(crate) async fn put_type(
        &self,
        r: v1::PutTaskTypeRequest,
        by: &Caller,
    ) -> Result<v1::PutTaskTypeResponse, Refusal> {
        let mut bad = Violations::default();
        let wire = r.r#type.ok_or_else(|| Refusal::field("type", "is required"))?;
        let (seen, site) = (revision_of(&wire.etag), &self.inner.parts.site);
        let of = parse_task_type(wire, At::top("type"), &|waypoint| site.find(waypoint).is_some(), &mut bad);
        bad.finish()?;
        let of = of.ok_or_else(internal)?;
        let command = TypeCommand::Put(of.clone());
        let types = self.change_types(&command, seen, r.validate_only, by).await?;
        let revision = types.find(&of.name).map(|(_, revision)| *revision);
        Ok(v1::PutTaskTypeResponse { r#type: Some(encode_task_type(&of, revision)) })
    }

    pub(crate) async fn delete_type(
        &self,
        r: v1::DeleteTaskTypeRequest,
        by: &Caller,
    ) -> Result<v1::DeleteTaskTypeResponse, Refusal> {
        if r.name.is_empty() {
            return Err(Refusal::field("name", "is required"));
        }
        let (command, seen) = (TypeCommand::Delete(r.name), revision_of(&r.etag));
        self.change_types(&command, seen, r.validate_only, by).await?;
        Ok(v1::DeleteTaskTypeResponse {})
    }

    pub(crate) async fn put_type_rules(
        &self,
        r: v1::PutTaskTypeRulesRequest,
        by: &Caller,
    ) -> Result<v1::PutTaskTypeRulesResponse, Refusal> {
        let wire = r.rules.ok_or_else(|| Refusal::field("rules", "is required"))?;
        let command = TypeCommand::PutRules(TypeRules { known_only: wire.known_only });
        let types = self.change_types(&command, revision_of(&wire.etag), r.validate_only, by).await?;
        Ok(v1::PutTaskTypeRulesResponse { rules: Some(encode_rules(types.rules())) })
    }

    /// Carries a change out, or only checks it; the types after it. A refusal for how things are leaves a row in the audit.
    async fn change_types(
        &self,
        command: &TypeCommand,
        seen: Option<Revision>,
        validate_only: bool,
        by: &Caller,
    ) -> Result<Arc<TypeCatalogue>, Refusal> {
        for _ in 0..TRIES {
            let types = self.newest_types().await?;
            let mut item = Item::new(Writer::Task, by);
            let decided = by
                .authorize(Permission::Operate, [])
                .and_then(|()| command.add_to(&mut item, &types, seen, &self.inner.parts.clock.now()));
            if validate_only || decided.is_ok() && item.is_empty() {
                return decided.map(|()| types);
            }
            if let Err(refusal) = decided {
                let item = Item::for_refusal(Writer::Task, by, None, command.note(), &refusal);
                drop(self.commit(item.into_iter().collect()).await);
                return Err(refusal);
            }
            item.audit(command.note());
            let result = self.commit(vec![item]).await.pop().ok_or_else(no_result)?;
            // A wake may come later than the answer to a commit.
            *self.kept_types() = None;
            match result {
                Ok(_) => return self.newest_types().await,
                Err(CommitError::Conflict { .. }) => {}
                Err(CommitError::Unknown(_)) => return Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
                Err(error) => return Err(unavailable(error)),
            }
        }
        Err(Refusal::new(Kind::Conflict, Code::EtagMismatch))
    }
}
