/* Subscriptions, and the thread that takes over from those of the middleware. */
#ifndef IGTL_GATEWAY_PASSAGE_SUBSCRIPTIONS_H
#define IGTL_GATEWAY_PASSAGE_SUBSCRIPTIONS_H

#include "_streams.h"

/* STATES.md has its states. */
struct Subscription {
    PyObject_HEAD
    Passage *passage;
    const void *pointer; /* rcl_subscription_t */
    Stream *stream;      /* owned; guarded by the sequence lock; NULL: all messages are Python's */
    pthread_mutex_t state;
    _Atomic int taker;             /* who may take; only from and to IDLE under `state` */
    int is_pending;                /* rcl has reported a message since the taker looked last; under `state` */
    int failure;                   /* a code of rcl that Python is to raise; of the taker, as what follows */
    enum holds holds;
    struct rcl_serialized message; /* of the taker */
    struct rcl_message_info info;
    size_t last_size; /* of the last message */
    /* losses, for TopicSubscription */
    uint64_t last_number; /* atomic */
    long long received, missing;
    Subscription *next_ready;
};

static void move_taker(Subscription *self, enum taker taker)
{
    int before = atomic_load_explicit(&self->taker, memory_order_relaxed);
    atomic_store_explicit(&self->taker, moved("a subscription", TAKER_MOVES, before, taker), memory_order_relaxed);
}

static void move_holds(Subscription *self, enum holds holds)
{
    self->holds = (enum holds)moved("what a subscription holds", HOLDS_MOVES, self->holds, holds);
}

/* Let a subscription, which WAITS, have its turn in the thread of subscriptions.  The caller has `events`. */
static void put_last(Passage *passage, Subscription *self)
{
    self->next_ready = NULL;
    *passage->ready_end = self;
    passage->ready_end = &self->next_ready;
}

/* Have that thread take from the subscription, which WAITS. */
static void note_subscription(Subscription *self)
{
    Passage *passage = self->passage;
    pthread_mutex_lock(&passage->events);
    put_last(passage, self);
    pthread_cond_signal(&passage->taken_over);
    pthread_mutex_unlock(&passage->events);
}

static void count_received(Subscription *self)
{
    uint64_t number = self->info.publication_number;
    add(&self->received);
    if (!number)
        return;
    if (self->last_number && number > self->last_number + 1)
        __atomic_add_fetch(&self->missing, (long long)(number - self->last_number - 1), __ATOMIC_RELAXED);
    __atomic_store_n(&self->last_number, number, __ATOMIC_RELAXED);
}

#endif
