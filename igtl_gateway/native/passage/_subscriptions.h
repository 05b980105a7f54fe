/* Subscriptions, and the thread that takes over from those of the middleware. */
#ifndef IGTL_GATEWAY_PASSAGE_SUBSCRIPTIONS_H
#define IGTL_GATEWAY_PASSAGE_SUBSCRIPTIONS_H

#include "_streams.h"

enum { IDLE, TAKING, WITH_PYTHON }; /* who takes from a subscription: no thread, one of the middleware, or Python */

struct Subscription {
    PyObject_HEAD
    Passage *passage;
    const void *pointer; /* rcl_subscription_t */
    Stream *stream;      /* owned; guarded by the sequence lock; NULL: all messages are Python's */
    pthread_mutex_t state;
    int taker, is_pending, is_ready, failure;
    struct rcl_serialized message; /* of the taker */
    struct rcl_message_info info;
    size_t last_size; /* of the last message */
    int is_held;      /* the message was taken, and has not passed */
    int is_refused;   /* it is large, and for Python */
    /* losses, for TopicSubscription */
    uint64_t last_number;
    long long received, missing;
    Subscription *next_ready;
};

/* Let a subscription wait for its turn in the thread of subscriptions.  The caller has `events`. */
static void put_last(Passage *passage, Subscription *self)
{
    self->is_ready = 1;
    self->next_ready = NULL;
    *passage->ready_end = self;
    passage->ready_end = &self->next_ready;
}

/* Have that thread take from the subscription. */
static void note_subscription(Subscription *self)
{
    Passage *passage = self->passage;
    pthread_mutex_lock(&passage->events);
    if (!self->is_ready) {
        put_last(passage, self);
        pthread_cond_signal(&passage->taken_over);
    }
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
    self->last_number = number;
}

#endif
