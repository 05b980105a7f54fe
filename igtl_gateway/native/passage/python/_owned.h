/* Memory of a message that Python then owns, without a second copy.
 *
 * rcl copies a ROS message into memory of our allocator.  The bytes of a large one become a memoryview of that memory,
 * which is freed with the last view; a small one is copied into bytes, and its memory serves again.
 */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_OWNED_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_OWNED_H

#include <stdlib.h>

#include "../_rcl.h"
#include "_types.h"

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

static PyTypeObject *OwnedBytes_Type;

static void owned_dealloc(OwnedBytes *self)
{
    free(self->bytes);
    free_object((PyObject *)self);
}

static int owned_buffer(OwnedBytes *self, Py_buffer *view, int flags)
{
    return PyBuffer_FillInfo(view, (PyObject *)self, self->bytes, self->size, 1, flags);
}

static PyType_Slot owned_slots[] = {
    {Py_tp_doc, "Read-only bytes in memory of their own."},
    {Py_tp_dealloc, owned_dealloc},
    {Py_bf_getbuffer, owned_buffer},
    {0, NULL},
};

static PyType_Spec owned_spec = {
    .name = "igtl_gateway.native._passage.OwnedBytes",
    .basicsize = sizeof(OwnedBytes),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .slots = owned_slots,
};

/* To be called once before anything else here; not 0: an exception is set. */
static inline int begin_owned(void)
{
    OwnedBytes_Type = (PyTypeObject *)PyType_FromSpec(&owned_spec);
    return OwnedBytes_Type ? 0 : -1;
}

/* Return a taken message as bytes or, if it is large, as a memoryview: then ``message`` has no memory any more. */
static inline PyObject *python_bytes(struct rcl_serialized *message)
{
    if (message->length < OWNED_BYTES)
        return PyBytes_FromStringAndSize((const char *)message->buffer, (Py_ssize_t)message->length);
    OwnedBytes *owned = PyObject_New(OwnedBytes, OwnedBytes_Type);
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

#endif
