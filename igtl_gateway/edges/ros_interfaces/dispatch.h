/* MESSAGE(package, msg, Name) and SERVICE(package, srv, Name): the handle that Python passes to rclpy.

   It contains the function of this extension that returns the type support which a middleware requests by name.
   (The code of rosidl_typesupport_c would search for it in shared libraries, which do not exist here.) */

#include <string.h>
#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_runtime_c/service_type_support_struct.h"

#define MESSAGE_SUPPORT(support, package, kind, name) \
  ROSIDL_TYPESUPPORT_INTERFACE__MESSAGE_SYMBOL_NAME(support, package, kind, name)
#define SERVICE_SUPPORT(support, package, kind, name) \
  ROSIDL_TYPESUPPORT_INTERFACE__SERVICE_SYMBOL_NAME(support, package, kind, name)

#define FIND(Handle, SUPPORT, package, kind, name) \
  const Handle * SUPPORT(rosidl_typesupport_fastrtps_c, package, kind, name)(void); \
  const Handle * SUPPORT(rosidl_typesupport_introspection_c, package, kind, name)(void); \
  static const Handle * name ## __find(const Handle * handle, const char * identifier) \
  { \
    if (strcmp(identifier, handle->typesupport_identifier) == 0) { \
      return handle; \
    } \
    if (strcmp(identifier, "rosidl_typesupport_fastrtps_c") == 0) { \
      return SUPPORT(rosidl_typesupport_fastrtps_c, package, kind, name)(); \
    } \
    if (strcmp(identifier, "rosidl_typesupport_introspection_c") == 0) { \
      return SUPPORT(rosidl_typesupport_introspection_c, package, kind, name)(); \
    } \
    return NULL; \
  }

#define DEFINE_HANDLE_GETTER(Handle, SUPPORT, package, kind, name) \
  const Handle * SUPPORT(rosidl_typesupport_c, package, kind, name)(void) \
  { \
    return &name ## __handle; \
  }

#define DESCRIPTION(package, kind, name) \
  &package ## __ ## kind ## __ ## name ## __get_type_hash, \
  &package ## __ ## kind ## __ ## name ## __get_type_description, \
  &package ## __ ## kind ## __ ## name ## __get_type_description_sources

#define MESSAGE(package, kind, name) \
  FIND(rosidl_message_type_support_t, MESSAGE_SUPPORT, package, kind, name) \
  static const rosidl_message_type_support_t name ## __handle = { \
    "rosidl_typesupport_c", NULL, name ## __find, DESCRIPTION(package, kind, name) \
  }; \
  DEFINE_HANDLE_GETTER(rosidl_message_type_support_t, MESSAGE_SUPPORT, package, kind, name)

#define SERVICE(package, kind, name) \
  MESSAGE(package, kind, name ## _Request) \
  MESSAGE(package, kind, name ## _Response) \
  MESSAGE(package, kind, name ## _Event) \
  FIND(rosidl_service_type_support_t, SERVICE_SUPPORT, package, kind, name) \
  static const rosidl_service_type_support_t name ## __handle = { \
    "rosidl_typesupport_c", NULL, name ## __find, \
    &name ## _Request__handle, &name ## _Response__handle, &name ## _Event__handle, \
    &ROSIDL_TYPESUPPORT_INTERFACE__SERVICE_CREATE_EVENT_MESSAGE_SYMBOL_NAME( \
      rosidl_typesupport_c, package, kind, name), \
    &ROSIDL_TYPESUPPORT_INTERFACE__SERVICE_DESTROY_EVENT_MESSAGE_SYMBOL_NAME( \
      rosidl_typesupport_c, package, kind, name), \
    DESCRIPTION(package, kind, name) \
  }; \
  DEFINE_HANDLE_GETTER(rosidl_service_type_support_t, SERVICE_SUPPORT, package, kind, name)
