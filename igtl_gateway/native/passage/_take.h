/* Taking a ROS message into memory that Python then owns, without a second copy.
 *
 * rcl copies the message into memory of our allocator.  The bytes of a large one become a memoryview of that memory,
 * which is freed with the last view; a small one is copied into bytes, and its memory serves again.
 */
#ifndef IGTL_GATEWAY_TAKE_H
#define IGTL_GATEWAY_TAKE_H

#include <Python.h>
#include <stdlib.h>
#include <string.h>

#include "_rcl.h"

/* From this size on, a copy costs more than an object with a view. */
#define OWNED_BYTES (16 * 1024)

static void *take_allocate(size_t size, void *state) { return (void)state, malloc(size); }
static void take_deallocate(void *pointer, void *state) { (void)state, free(pointer); }
static void *take_reallocate(void *pointer, size_t size, void *state) { return (void)state, realloc(pointer, size); }
static void *take_zero_allocate(size_t number, size_t size, void *state) { return (void)state, calloc(number, size); }

static const struct rcl_allocator TAKE_ALLOCATOR = {take_allocate, take_deallocate, take_reallocate, take_zero_allocate,
                                                    NULL};

typedef struct {
    PyObject_HEAD
    uint8_t *bytes;
    Py_ssize_t size;
} OwnedBytes;

static void owned_dealloc(OwnedBytes *self)
{
    free(self->bytes);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static int owned_buffer(OwnedBytes *self, Py_buffer *view, int flags)
{
    return PyBuffer_FillInfo(view, (PyObject *)self, self->bytes, self->size, 1, flags);
}

static PyBufferProcs owned_procs = {.bf_getbuffer = (getbufferproc)owned_buffer};

static PyTypeObject owned_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "igtl_gateway.OwnedBytes",
    .tp_basicsize = sizeof(OwnedBytes),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_dealloc = (destructor)owned_dealloc,
    .tp_as_buffer = &owned_procs,
    .tp_doc = "Read-only bytes in memory of their own.",
};

/* To be called once before anything else here; not 0: an exception is set. */
static inline int begin_take(void) { return PyType_Ready(&owned_type); }

/* Return a taken message as bytes or, if it is large, as a memoryview: then ``message`` has no memory any more. */
static inline PyObject *python_bytes(struct rcl_serialized *message)
{
    if (message->length < OWNED_BYTES)
        return PyBytes_FromStringAndSize((const char *)message->buffer, (Py_ssize_t)message->length);
    OwnedBytes *owned = PyObject_New(OwnedBytes, &owned_type);
    if (!owned)
        return NULL;
    owned->bytes = message->buffer;
    owned->size = (Py_ssize_t)message->length;
    message->buffer = NULL;
    message->length = message->capacity = 0;
    PyObject *view = PyMemoryView_FromObject((PyObject *)owned);
    Py_DECREF(owned);
    return view;
}

/* Take a message without the GIL: its bytes, source stamp (UTC ns) and publication number; None: there is none.
 *
 * ``memory``: for this and the next messages of one thread, with TAKE_ALLOCATOR; its owner frees ``buffer``.  The caller
 * ensures that nobody destroys the subscription meanwhile.  Raises RuntimeError if rcl refuses.
 */
static inline PyObject *take_serialized(rcl_take_function take, const void *subscription, struct rcl_serialized *memory)
{
    struct rcl_message_info info = {0};
    int32_t code;
    Py_BEGIN_ALLOW_THREADS
    code = take(subscription, memory, &info, NULL);
    Py_END_ALLOW_THREADS
    if (code == RCL_RET_SUBSCRIPTION_TAKE_FAILED)
        Py_RETURN_NONE;
    if (code != RCL_RET_OK)
        return PyErr_Format(PyExc_RuntimeError, "rcl cannot take a message (code %d)", (int)code);
    PyObject *cdr = python_bytes(memory);
    if (!cdr)
        return NULL;
    return Py_BuildValue("NLK", cdr, (long long)info.source_ns, (unsigned long long)info.publication_number);
}

#endif
