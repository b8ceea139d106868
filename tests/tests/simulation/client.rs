//! Programs that submit and cancel: they repeat what was not answered, word for word, until it is.
//!
//! Invariant: an answer that did not come changes nothing: the request is the same, and so is its request_id.

use crate::net;
use crate::orders::{self, Order};
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{CancelTaskRequest, SubmitTaskRequest};
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;
use tonic::Code;
use tonic::transport::Channel;

/// A program's patience.
const ANSWER: Duration = Duration::from_millis(1_500);
/// The same for an order, which is up to eight questions.
const ORDER_ANSWER: Duration = Duration::from_millis(6_000);
/// Between two tries.
const PAUSE: Duration = Duration::from_millis(300);

/// One wish.
#[derive(Clone, Debug)]
pub enum Wish {
    /// A new task.
    Submit(Box<SubmitTaskRequest>),
    /// The end of one.
    Cancel(CancelTaskRequest),
    /// Something about software.
    Order(Box<Order>),
}

/// What is wished, in order, and what came of it. It outlives the clients.
#[derive(Default)]
pub struct Desk {
    waiting: RefCell<VecDeque<Wish>>,
    /// Answers that did not come.
    pub unanswered: Cell<u64>,
    /// Tasks that were said to be admitted.
    pub admitted: Cell<u64>,
    /// Orders about software that were carried out whole.
    pub obeyed: Cell<u64>,
    /// Refusals nobody should get.
    pub refused: RefCell<Vec<String>>,
}

impl Desk {
    /// Puts a wish at the end.
    pub fn wish(&self, wish: Wish) {
        self.waiting.borrow_mut().push_back(wish);
    }
    /// Nothing waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.borrow().is_empty()
    }
    fn first(&self) -> Option<Wish> {
        self.waiting.borrow().front().cloned()
    }
    fn done(&self) {
        self.waiting.borrow_mut().pop_front();
    }
}

/// Carries wishes out for ever.
pub async fn run(desk: Rc<Desk>) -> turmoil::Result {
    let mut client = TaskServiceClient::new(net::channel()?);
    loop {
        let Some(wish) = desk.first() else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
        if let Wish::Order(order) = &wish {
            match tokio::time::timeout(ORDER_ANSWER, orders::carry_out(order)).await {
                Ok(Ok(whole)) => {
                    desk.obeyed.set(desk.obeyed.get() + u64::from(whole));
                    desk.done();
                }
                Ok(Err(_)) | Err(_) => {
                    desk.unanswered.set(desk.unanswered.get() + 1);
                    tokio::time::sleep(PAUSE).await;
                }
            }
            continue;
        }
        match tokio::time::timeout(ANSWER, ask(client.clone(), &wish)).await {
            Ok(Ok(())) => {
                if matches!(wish, Wish::Submit(_)) {
                    desk.admitted.set(desk.admitted.get() + 1);
                }
                desk.done();
            }
            // A task that is over cannot be canceled: an answer like any other.
            Ok(Err(status)) if status.code() == Code::FailedPrecondition && matches!(wish, Wish::Cancel(_)) => {
                desk.done()
            }
            Ok(Err(status)) if is_final(status.code()) => {
                desk.refused.borrow_mut().push(format!("{wish:?}: {status}"));
                desk.done();
            }
            Ok(Err(_)) | Err(_) => {
                desk.unanswered.set(desk.unanswered.get() + 1);
                // Bytes that were lost do not come again here: the connection may be dead.
                client = TaskServiceClient::new(net::channel()?);
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
}

fn is_final(code: Code) -> bool {
    matches!(
        code,
        Code::InvalidArgument | Code::AlreadyExists | Code::NotFound | Code::FailedPrecondition | Code::Internal
    )
}

async fn ask(mut client: TaskServiceClient<Channel>, wish: &Wish) -> Result<(), tonic::Status> {
    match wish.clone() {
        Wish::Submit(request) => client.submit_task(*request).await.map(|_| ()),
        Wish::Cancel(request) => client.cancel_task(request).await.map(|_| ()),
        Wish::Order(_) => Ok(()),
    }
}
