//! Calls of any method that the descriptors name, by anybody, with messages that are made of their descriptions.

use crate::harness::authority;
use crate::secrets::{keep_secret, secret_part};
use anyhow::{Context, ensure};
use midshift_agent::dial::TcpDial;
use midshift_agent::tls::{self, Tls};
use midshift_core::identity::{Access, Caller};
use midshift_proto::access;
use midshift_tests::raw::Raw;
use prost::Message;
use prost::bytes::Bytes;
use prost_reflect::{DescriptorPool, DynamicMessage, FieldDescriptor, Kind, MessageDescriptor, MethodDescriptor};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;
use tonic::client::Grpc;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};

/// A stream on which nothing comes for so long has let its caller in: a denial is the first that comes.
const LISTEN: Duration = Duration::from_secs(10);
/// Messages within messages at most.
const DEEP: u32 = 5;

/// One method, as it is declared.
pub struct Method {
    /// As a request names it.
    pub path: String,
    /// Its rule.
    pub rule: Access,
    is: MethodDescriptor,
}

impl Method {
    /// Every one of every service of ours.
    pub fn all() -> anyhow::Result<Vec<Self>> {
        let pool = DescriptorPool::decode(midshift_proto::FILE_DESCRIPTOR_SET)?;
        let methods = pool.services().flat_map(|service| service.methods().collect::<Vec<_>>());
        methods
            .map(|is| {
                let path = format!("/{}/{}", is.parent_service().full_name(), is.name());
                Ok(Self { rule: access::find(&path).with_context(|| format!("{path} has no rule"))?, path, is })
            })
            .collect()
    }
    /// Its name without its service.
    pub fn name(&self) -> &str {
        self.is.name()
    }
    /// Its request with each field that these words know by name.
    pub fn filled(&self, words: &Words) -> anyhow::Result<Vec<u8>> {
        let of = self.is.input();
        let (fields, _) = filled(&of, words, DEEP);
        let message = DynamicMessage::deserialize(of, Value::Object(fields));
        Ok(message.with_context(|| self.path.clone())?.encode_to_vec())
    }
    /// Answers as JSON, one a line.
    pub fn read(&self, answers: &[Bytes]) -> anyhow::Result<String> {
        let read = |answer: &Bytes| DynamicMessage::decode(self.is.output(), answer.clone());
        let read = answers.iter().map(|answer| Ok(serde_json::to_string(&read(answer)?)?));
        Ok(read.collect::<anyhow::Result<Vec<_>>>()?.join("\n"))
    }
}

/// What to write into fields, by their names; null: they stay empty.
pub type Words = BTreeMap<&'static str, Value>;

/// Fields of a message, and how many words are in them.
fn filled(of: &MessageDescriptor, words: &Words, deep: u32) -> (Map<String, Value>, usize) {
    let (mut fields, mut count) = (Map::new(), 0);
    let mut add = |field: &FieldDescriptor, (value, found): (Value, usize)| {
        fields.insert(field.name().to_owned(), value);
        count += found;
    };
    let given = |field: FieldDescriptor| value(&field, words, deep).map(|value| (field, value));
    for field in of.fields().filter(|field| field.containing_oneof().is_none_or(|oneof| oneof.is_synthetic())) {
        given(field).into_iter().for_each(|(field, value)| add(&field, value));
    }
    for oneof in of.oneofs().filter(|oneof| !oneof.is_synthetic()) {
        // The one of which most is known.
        let most = oneof.fields().filter_map(given).max_by_key(|(_, (_, found))| *found);
        most.into_iter().for_each(|(field, value)| add(&field, value));
    }
    (fields, count)
}

fn value(field: &FieldDescriptor, words: &Words, deep: u32) -> Option<(Value, usize)> {
    let (value, found) = match (words.get(field.name()), field.kind()) {
        (Some(Value::Null), _) => return None,
        // A mask is written as one word.
        (Some(word), Kind::Message(of)) if of.full_name() == "google.protobuf.FieldMask" => (word.clone(), 1),
        (Some(word), kind) if !matches!(kind, Kind::Message(_)) => (word.clone(), 1),
        (_, Kind::Message(of)) if deep > 0 && !field.is_map() && !of.full_name().starts_with("google.") => {
            let (fields, found) = filled(&of, words, deep - 1);
            (Value::Object(fields), found)
        }
        _ => return None,
    };
    (found > 0).then(|| (if field.is_list() { json!([value]) } else { value }, found))
}

/// Somebody with a connection of its own to one port.
pub struct Somebody {
    /// For people.
    pub name: String,
    /// As the port should see it.
    pub caller: Caller,
    channel: Channel,
    token: Option<String>,
}

impl Somebody {
    /// With a token, or without.
    pub fn new(name: &str, caller: Caller, port: SocketAddr, token: Option<&str>) -> anyhow::Result<Self> {
        if let Some(token) = token {
            keep_secret("a token of a role", secret_part(token)?);
        }
        let root = std::fs::read_to_string(authority(port)?)?;
        let site = Tls::fixed(tls::config(&root, None)?);
        Ok(Self { token: token.map(str::to_owned), ..Self::with(name, caller, port, site)? })
    }
    /// With a certificate.
    pub fn with(name: &str, caller: Caller, port: SocketAddr, tls: Tls) -> anyhow::Result<Self> {
        let channel = TcpDial::new(&format!("https://{port}"), None)?.with_tls(tls).lazy();
        Ok(Self { name: name.to_owned(), caller, channel, token: None })
    }
    /// What the declared rule of a path answers; none: it lets it in.
    pub fn refused(&self, path: &str) -> Option<Code> {
        let refusal = access::check(&self.caller, path).err()?;
        Some(midshift_proto::status(&refusal, None).code())
    }
    /// One message, and nothing more; what comes first: so many answers, fewer, or a status.
    pub async fn asks(
        &self,
        method: &Method,
        message: Vec<u8>,
        most: usize,
    ) -> anyhow::Result<Result<Vec<Bytes>, Status>> {
        let mut client = Grpc::new(self.channel.clone());
        client.ready().await?;
        let mut request = Request::new(tokio_stream::once(Bytes::from(message)));
        if let Some(token) = &self.token {
            request.metadata_mut().insert("authorization", format!("Bearer {token}").parse()?);
        }
        let path: PathAndQuery = method.path.parse()?;
        let mut answers = Vec::new();
        let asked = async {
            let mut stream = client.streaming(request, path, Raw).await?.into_inner();
            while answers.len() < most
                && let Some(answer) = stream.message().await?
            {
                answers.push(answer);
            }
            Ok::<_, Status>(())
        };
        let asked = tokio::time::timeout(LISTEN, asked).await.unwrap_or(Ok(()));
        let answer = asked.map(|()| answers);
        if let Err(status) = &answer {
            let is_said = std::error::Error::source(status).is_none() && status.code() != Code::Internal;
            ensure!(is_said, "{} {}: {status:?}", self.name, method.path);
        }
        Ok(answer)
    }
}
