/* The native passage: messages of compiled streams, from the socket or the DDS reader to the other side, without the GIL.
 *
 * igtl_gateway/native/passage/__init__.py documents what it is for; passage/STATES.md has the states of a large message and
 * of a subscription.  Everything here is optional: a message that is not as its stream expects goes to Python, which has
 * the same streams, and gives the same entries.
 *
 * This file makes a module of the rooms below passage/, as one unit, so that what a message passes is inlined.
 */
#include "passage/python/_passage.h"

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_passage", "See igtl_gateway.native.passage.", -1, NULL,
                                        NULL, NULL, NULL, NULL};

/* Make a class of the module; 0: an exception is set. */
static int add_type(PyObject *module, PyType_Spec *spec, PyTypeObject **type)
{
    *type = (PyTypeObject *)PyType_FromSpec(spec);
    return *type && !PyModule_AddType(module, *type);
}

PyMODINIT_FUNC PyInit__passage(void)
{
    begin_bytes();
    begin_bulk(1);
    if (begin_owned())
        return NULL;
    PyObject *module = PyModule_Create(&definition);
    if (module && !(add_type(module, &lock_spec, &Lock_Type) && add_type(module, &passage_spec, &Passage_Type) &&
                    add_type(module, &link_spec, &Link_Type) && add_type(module, &subscription_spec, &Subscription_Type) &&
                    add_type(module, &publisher_spec, &Publisher_Type) && add_type(module, &stream_spec, &Stream_Type) &&
                    add_type(module, &guard_spec, &Guard_Type)))
        Py_CLEAR(module);
    return module;
}
